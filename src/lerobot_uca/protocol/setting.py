"""Settings for training and evaluating cells: a YAML file, or the name of one in this package's folder `settings`."""

import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict, astuple, dataclass, field, fields
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple, Self

import yaml

from lerobot_uca.errors import UserError
from lerobot_uca.features import OBJECT_CLOUD, POINT_CLOUD
from lerobot_uca.protocol.cells import ENVIRONMENTS, POLICIES, SUITES, Cell

FOLDER = files("lerobot_uca.protocol") / "settings"

FIRST_TUNING_SEED = 100
"""Training seeds from here on are for choosing a setting. Their episodes are others than those of the tables."""
INTERIM_SEEDS, FINAL_SEEDS, TUNING_OFFSET = 2_000_000, 4_000_000, 10_000_000
"""The first seeds of evaluation episodes. Demonstrations start at 1 million, LeRobot's evaluations at 1000."""


@dataclass(frozen=True)
class Length:
    """The length of a task's training, and the evaluations meanwhile."""

    steps: int
    evaluations: int
    """Evenly spaced, the last one after the last step."""

    @property
    def interval(self) -> int:
        """Steps between two evaluations."""
        return self.steps // self.evaluations


class _Rule(NamedTuple):
    """What a field of a setting may hold."""

    keys: Collection[str]
    is_valid: Callable[[Any], bool]
    words: str


def _is_number(value: Any) -> bool:
    """Python calls truth a whole number, too."""
    return isinstance(value, int | float) and not isinstance(value, bool)


_DEMONSTRATOR_RULES = {
    "smoothing": _Rule(
        SUITES["all"],
        lambda value: _is_number(value) and 0 < value <= 1,
        "numbers above 0 and up to 1 by 'benchmark/task'",
    ),
    "straight_paths": _Rule(
        ("metaworld",), lambda value: isinstance(value, bool), "true or false by benchmark, metaworld alone"
    ),
    "pushes": _Rule(
        ("metaworld",),
        lambda value: _is_number(value) and 0 <= value < 1,
        "a number from 0 and below 1 by benchmark, metaworld alone",
    ),
    "successful_steps": _Rule(  # of Adroit's success is decided at the end
        ("metaworld",),
        lambda value: type(value) is int and value >= 1,
        "a whole number above 0 by benchmark, metaworld alone",
    ),
    "observation": _Rule(
        ENVIRONMENTS,
        lambda value: value in (POINT_CLOUD, OBJECT_CLOUD),
        f"{POINT_CLOUD} or {OBJECT_CLOUD} by benchmark ({', '.join(ENVIRONMENTS)})",
    ),
}


@dataclass(frozen=True)
class Setting:
    """All that decides a cell's result besides task, policy and seed."""

    name: str
    """The file's name without its ending, unless the file holds another."""
    description: str
    """One line, printed with every table."""
    batch_size: int
    lengths: Mapping[str, Length]
    """Lengths by 'benchmark' or 'benchmark/task'; the latter counts where both are there."""
    demonstrations: int = 10
    """Expert episodes of a task."""
    smoothing: Mapping[str, float] = field(default_factory=dict)
    """The smoothing of experts' actions by task, as for lerobot-uca-collect."""
    straight_paths: Mapping[str, bool] = field(default_factory=dict)
    """Whether experts' hands go straight, by benchmark, as for lerobot-uca-collect."""
    pushes: Mapping[str, float] = field(default_factory=dict)
    """The probability of pushes by benchmark, as for lerobot-uca-collect."""
    successful_steps: Mapping[str, int] = field(default_factory=dict)
    """Successful steps after which a demonstration ends, by benchmark, as for lerobot-uca-collect."""
    observation: Mapping[str, str] = field(default_factory=dict)
    """The environments' observation by benchmark, point_cloud or object_cloud, the former by default."""
    interim_episodes: int = 20
    """Episodes of each evaluation during training."""
    final_episodes: int = 100
    """Episodes of the last checkpoint's evaluation, on seeds that nothing else uses."""
    policy: Mapping[str, Any] = field(default_factory=dict)
    """Options of all policies."""
    benchmarks: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Further options of all policies by benchmark."""
    policies: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Further options by policy type."""

    @classmethod
    def load(cls, name: str) -> Self:
        """The setting of a name, or of the path of a YAML file or a run's setting.json.

        Raises:
            UserError: if there is none, or it does not hold what a setting holds.
        """
        known = {Path(file.name).stem: file for file in FOLDER.iterdir() if file.name.endswith(".yaml")}
        path = Path(name)
        if name not in known and not path.is_file():
            raise UserError(f"Unknown setting '{name}'. Settings: {', '.join(sorted(known))}, or a file's path.")
        try:
            text = known.get(name, path).read_text(encoding="utf-8")
            values = json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)  # to YAML 5e-05 is a word
        except (OSError, ValueError, yaml.YAMLError) as error:
            raise UserError(f"Setting '{name}' cannot be read: {' '.join(str(error).split())}") from error
        return cls.from_values(path.stem, values)

    @classmethod
    def from_values(cls, name: str, values: Any) -> Self:
        """Make a setting of a file's values, which may hold another name than the file's."""
        valid = [each.name for each in fields(cls)]
        if not isinstance(values, dict) or not set(values) <= set(valid):
            got = ", ".join(map(str, values)) if isinstance(values, dict) else type(values).__name__
            raise UserError(f"Setting '{name}' may hold {', '.join(valid)}, got {got}.")
        if not isinstance(values.get("name", name), str):
            raise UserError(f"Setting '{name}': name must be text, got {values['name']!r}.")
        try:
            lengths = {key: Length(**length) for key, length in values["lengths"].items()}
            setting = cls(**{"name": name, **values, "lengths": lengths})
        except (KeyError, TypeError, AttributeError) as error:
            raise UserError(f"Setting '{name}' is not complete: {error}.") from error
        setting.check()
        return setting

    def check(self) -> None:
        """Raise a `UserError` for values that cannot be."""
        self._check_mappings()
        try:
            json.dumps(self.as_values(), allow_nan=False)
        except (TypeError, ValueError) as error:
            raise UserError(f"Setting '{self.name}' holds what no setting can hold: {error}.") from error
        counts = ("batch_size", "demonstrations", "interim_episodes", "final_episodes")
        for name, value in [(name, getattr(self, name)) for name in counts]:
            if type(value) is not int or value < 1:
                raise UserError(f"Setting '{self.name}': {name} must be a whole number above 0, got {value!r}.")
        self._check_lengths()
        self._check_demonstrators()
        self._check_options()

    def _check_options(self) -> None:
        types = sorted({method.type for method in POLICIES.values()})
        options = {"policy": self.policy}
        for field_name, what, valid in (("benchmarks", "benchmark", list(ENVIRONMENTS)), ("policies", "type", types)):
            for name, further in getattr(self, field_name).items():
                if name not in valid:
                    raise UserError(
                        f"Setting '{self.name}': {field_name} holds options by {what} ({', '.join(valid)}), "
                        f"got '{name}'."
                    )
                options[f"{field_name}.{name}"] = further
        for name, values in options.items():
            if "type" in values:
                raise UserError(
                    f"Setting '{self.name}': {name} may hold any option but type, which --policies names, got "
                    f"{values['type']!r}."
                )

    def _check_lengths(self) -> None:
        for key, (steps, evaluations) in ((key, astuple(length)) for key, length in self.lengths.items()):
            if key not in ENVIRONMENTS and key not in SUITES["all"]:
                raise UserError(
                    f"Setting '{self.name}': lengths holds steps and evaluations by benchmark "
                    f"({', '.join(ENVIRONMENTS)}) or 'benchmark/task', got '{key}'."
                )
            are_whole = type(steps) is type(evaluations) is int
            if not are_whole or evaluations < 1 or steps < 1 or steps % evaluations:
                raise UserError(
                    f"Setting '{self.name}': steps of {key} must be a whole number above 0 and a multiple of its "
                    f"evaluations, got {steps!r} and {evaluations!r}."
                )

    def _check_mappings(self) -> None:
        values = {each.name: getattr(self, each.name) for each in fields(self) if each.default_factory is dict}
        for outer in ("benchmarks", "policies"):
            if isinstance(values[outer], Mapping):
                values |= {f"{outer}.{key}": options for key, options in values[outer].items()}
        for name, value in values.items():
            if not isinstance(value, Mapping):
                raise UserError(f"Setting '{self.name}': {name} must hold values by name, got {value!r}.")

    def _check_demonstrators(self) -> None:
        for name, rule in _DEMONSTRATOR_RULES.items():
            for key, value in getattr(self, name).items():
                if key not in rule.keys or not rule.is_valid(value):
                    raise UserError(f"Setting '{self.name}': {name} holds {rule.words}, got {key}: {value!r}.")

    def as_values(self) -> dict[str, Any]:
        """The setting as plain values, for JSON."""
        return asdict(self)

    def length(self, cell: Cell) -> Length:
        """The length of a cell's training."""
        for key in (cell.task, cell.benchmark):
            if key in self.lengths:
                return self.lengths[key]
        raise UserError(f"Setting '{self.name}' has no length for {cell.task}: lengths of {', '.join(self.lengths)}.")

    def policy_options(self, cell: Cell) -> dict[str, Any]:
        """Options of a cell's policy, without 'policy.'."""
        method = POLICIES[cell.policy]
        of_benchmark, of_type = self.benchmarks.get(cell.benchmark, {}), self.policies.get(method.type, {})
        return {"type": method.type, **self.policy, **of_benchmark, **of_type, **method.options}

    def interim_seeds(self, cell: Cell, evaluation: int) -> range:
        """Seeds of the episodes of a cell's evaluation 0, 1, ... during training: the same for all policies."""
        first = INTERIM_SEEDS + _tuning(cell) + evaluation * self.interim_episodes
        return range(first, first + self.interim_episodes)

    def final_seeds(self, cell: Cell) -> range:
        """Seeds of the episodes of a cell's last checkpoint: the same for all policies, used by nothing else."""
        first = FINAL_SEEDS + _tuning(cell)
        return range(first, first + self.final_episodes)


def _tuning(cell: Cell) -> int:
    return TUNING_OFFSET if cell.seed >= FIRST_TUNING_SEED else 0
