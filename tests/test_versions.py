"""Versions: each dependency has a range, and constraints.txt pins all that is installed, inside of these ranges."""

import importlib.metadata
import re
from pathlib import Path

import pytest
from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from tests import compat

ROOT = Path(__file__).parent.parent
PROJECT = "lerobot_policy_uca_flow"
LINES = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if line and not line.startswith("#")]
PINS = {canonicalize_name(name): Version(version) for name, version in (line.split("==") for line in LINES)}


def test_every_line_of_constraints_is_one_exact_version():
    assert len(PINS) == len(LINES)
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+", line) for line in LINES)


def test_every_dependency_has_a_lowest_and_a_highest_version():
    """A range without an end promises to work with what nobody has tried."""
    for requirement in compat.declared():
        operators = {each.operator for each in requirement.specifier}
        assert operators & {"==", "<"}, requirement
        assert Version(compat.lowest(requirement).split("==")[1]) in requirement.specifier


@pytest.mark.parametrize("package", ["lerobot", "torch", "mujoco", "gymnasium", "openvino", "onnxruntime"])
def test_what_the_package_is_made_of_is_declared(package):
    assert package in {requirement.name for requirement in compat.declared()}


def requirements_of(name: str, extras: set[str]) -> list[Requirement]:
    """What an installed distribution asks for on this machine, with these extras."""
    asked = map(Requirement, importlib.metadata.requires(name) or [])
    environments = [{**default_environment(), "extra": extra} for extra in ("", *extras)]
    return [each for each in asked if each.marker is None or any(map(each.marker.evaluate, environments))]


def all_requirements() -> list[tuple[str, Requirement]]:
    """Who asks for what, from this package and its extras down to the last dependency."""
    seen: set[tuple[str, frozenset[str]]] = set()
    found, waiting = [], [(PROJECT, frozenset({"dev"}))]
    while waiting:
        name, extras = waiting.pop()
        if (name, extras) in seen:
            continue
        seen.add((name, extras))
        for requirement in requirements_of(name, set(extras)):
            found.append((name, requirement))
            waiting.append((canonicalize_name(requirement.name), frozenset(requirement.extras)))
    return found


def test_constraints_pin_every_dependency_inside_its_range():
    """So an audit of constraints.txt (audit.py) is one of all that `make` installs."""
    for asker, requirement in all_requirements():
        name = canonicalize_name(requirement.name)
        if name == canonicalize_name(PROJECT):
            continue
        assert name in PINS, f"{asker} asks for {requirement}, which constraints.txt does not pin"
        assert requirement.specifier.contains(PINS[name], prereleases=True), f"{asker} asks for {requirement}"


def test_mujoco_4_0_0_is_excluded_by_name():
    (mujoco,) = [each for each in compat.declared() if each.name == "mujoco"]
    assert "!=4.0.0" in str(mujoco.specifier)
