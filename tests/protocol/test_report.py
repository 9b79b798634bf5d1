"""Tables and figures of results made up so that every number can be told in advance."""

import csv
import errno
import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from tests.browser import browser, needs_browser
from tests.robots.conftest import wait_until

from lerobot_uca.errors import UserError
from lerobot_uca.protocol import results
from lerobot_uca.protocol.cells import PAPER_GROUPS, POLICIES, SUITES, Cell
from lerobot_uca.protocol.command import main
from lerobot_uca.protocol.figures import COLOURS, FIGURES
from lerobot_uca.protocol.folder import RunFolder, write_json
from lerobot_uca.protocol.intervals import mean_rate, wilson
from lerobot_uca.protocol.paper import ABLATION, COLUMNS, MILLISECONDS, SUCCESS, goal
from lerobot_uca.protocol.results import Results
from lerobot_uca.protocol.rows import Row, write_rows
from lerobot_uca.protocol.setting import FIRST_TUNING_SEED, Setting
from lerobot_uca.whole_file import whole_file

SETTING = Setting.from_values(
    "tiny",
    {"description": "made up", "batch_size": 8, "lengths": {"metaworld": {"steps": 60, "evaluations": 6}}},
)
REACH, WALL = "metaworld/reach", "metaworld/reach-wall"


def make_rows(cell, n_final, interim):
    """`n_final` of 100 fresh episodes succeed, and of each evaluation's 20 as many as `interim` says."""
    for index in range(100):
        yield Row(*cell, 60, 6.0, True, 4_000_000 + index, index < n_final, 1.5, 200, 5.0)
    for evaluation, n_successes in enumerate(interim, start=1):
        for index in range(20):
            seed = 2_000_000 + 20 * evaluation + index
            yield Row(*cell, 10 * evaluation, float(evaluation), False, seed, index < n_successes, 1.5, 200, 5.0)


def add_cell(folder, cell, n_final, interim=(0, 20, 20, 20, 20, 10)):
    files = folder.cell(cell)
    files.rows.mkdir(parents=True)
    rows = list(make_rows(cell, n_final, interim))
    write_rows(files.rows / "final.csv", [row for row in rows if row.is_final])
    write_rows(files.rows / "step.csv", [row for row in rows if not row.is_final])
    record = {
        "cell": cell._asdict(),
        "inference": {"median_ms": 2.0 + cell.seed},
        "minutes": {"training": 6.0, "evaluation": 1.0},
        "hardware": {"cpu": "a CPU", "gpu": None, "cores": 2, "threads": 1},
        "dtype": ("bfloat16", "float32")[cell.seed % 2],
    }
    write_json(files.result, record)


@pytest.fixture
def folder(tmp_path):
    """Two tasks, two seeds of UCA-Flow and one of AdaLN on one of them."""
    folder = RunFolder.create(tmp_path / "run", SETTING)
    for seed, n_final in enumerate((80, 90)):
        add_cell(folder, Cell(REACH, "uca_flow", seed), n_final)
        add_cell(folder, Cell(WALL, "uca_flow", seed), 100)
    add_cell(folder, Cell(REACH, "adaln", 0), 60)
    return folder


def read_csv(path):
    with path.open(newline="") as file:
        return list(csv.reader(file))


def test_the_papers_averages_are_the_means_of_its_columns():
    """The numbers are as printed: they were copied right. Only UCA-Flow's own average success does not agree."""
    n_tasks = [1, 1, 1, *(len(PAPER_GROUPS[group]) for group in ("easy", "medium", "hard", "very_hard"))]
    for table in (SUCCESS, MILLISECONDS):
        for policy, row in table.items():
            *numbers, printed = (row[column].mean for column in COLUMNS)
            mean = sum(n * number for n, number in zip(n_tasks, numbers, strict=True)) / 37
            expected = 86.4 if table is SUCCESS and policy == "uca_flow" else printed
            assert mean == pytest.approx(expected, abs=0.15)
    assert set(ABLATION) < set(POLICIES)
    assert all(tuple(row) == SUITES["ablation"] for row in ABLATION.values())
    for task in ("door", "pen"):
        assert ABLATION["uca_flow"][f"adroit/{task}"] == SUCCESS["uca_flow"][task]


def test_table_1(folder, tmp_path, capsys):
    main(["report", str(folder.path), f"--output={tmp_path}/report"])
    header, *rows = read_csv(tmp_path / "report" / "table_1.csv")
    assert header[2:] == [
        *("Adroit hammer", "Adroit door", "Adroit pen", "easy (21)", "medium (4)", "hard (4)", "very hard (5)"),
        "average (37)",
    ]
    lines = {(rows[index - index % 3][0], row[1]): row[2:] for index, row in enumerate(rows)}
    assert lines["UCA-Flow", "paper"][3] == "92.4 +- 1.2"
    # The best five of 0, 100, 100, 100, 100 and 50 %.
    assert lines["UCA-Flow", "ours, paper's rule"][3] == "90.0 +- 0.0 (2 of 21 tasks)"
    honest = lines["UCA-Flow", "ours, honest"]
    assert honest[:3] == ["missing"] * 3
    assert honest[3].startswith("92.5 [")  # the mean of 85 and 100
    assert honest[3].endswith("(2 of 21 tasks)")
    assert honest[7].endswith("(2 of 37 tasks)")
    assert lines["DP3", "ours, honest"] == ["missing"] * 8
    kinds = "; ".join(f"a CPU (2 cores, 1 thread a cell, trained in {dtype})" for dtype in ("bfloat16", "float32"))
    assert f"Setting 'tiny': made up. Made on: {kinds}." in capsys.readouterr().out


WIDE = """\\documentclass{article}
\\usepackage{booktabs,graphicx}
\\begin{document}
TABLES
\\end{document}
"""


def latex_tables(folder, tmp_path):
    main(["report", str(folder.path), f"--output={tmp_path}/report"])
    return {path.name: path.read_text() for path in sorted((tmp_path / "report").glob("*.tex"))}


def test_latex_is_balanced_and_escaped(tmp_path):
    """Also with a setting that is called and described as nobody would."""
    setting = replace(SETTING, name="a_b", description=r"50 % & #1 of {x}_y^2, c:\d ~ $3 <4> or not")
    folder = RunFolder.create(tmp_path / "run", setting)
    for policy, n_final in (("uca_flow", 80), ("adaln", 60)):
        add_cell(folder, Cell(REACH, policy, 0), n_final)
    tables = latex_tables(folder, tmp_path)
    assert len(tables) == 5
    for text in tables.values():
        assert r"50 \% \& \#1 of \{x\}\_y\textasciicircum{}2, c:\textbackslash{}d \textasciitilde{} \$3 $<$4$>$" in text
        plain = re.sub(r"\\[\\%_&#{}$]", "", text)  # without what is escaped
        assert plain.count("{") == plain.count("}")
        assert plain.count("$") % 2 == 0
        assert "^" not in plain
        assert "#" not in plain
        assert re.findall(r"%.*", plain) == ["%", "%"]  # at the ends of lines, where no space shall be
        _, columns, body = re.split(r"\\begin\{tabular\}\{([lc]*)\}", text)
        rows = [line for line in body.splitlines() if line.endswith(r"\\")]
        assert {len(re.findall(r"(?<!\\)&", row)) for row in rows} == {len(columns) - 1}


def test_cells_in_latex(folder, tmp_path):
    table = latex_tables(folder, tmp_path)["table_1.tex"]
    assert r"$92.4_{\pm 1.2}$" in table
    assert r"$90.0_{\pm 0.0}$\textsuperscript{2 of 21 tasks}" in table
    assert re.search(r"\$92\.5_\{\[[\d.]+, [\d.]+\]\}\$\\textsuperscript\{2 of 21 tasks\}", table)
    assert "missing" in table


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="needs LaTeX")
def test_latex_compiles_to_tables_on_the_page(folder, tmp_path):
    (tmp_path / "all.tex").write_text(WIDE.replace("TABLES", "\n".join(latex_tables(folder, tmp_path).values())))
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "all.tex"]
    result = subprocess.run(command, check=False, cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout
    assert "Overfull" not in result.stdout
    assert (tmp_path / "all.pdf").read_bytes().startswith(b"%PDF")


def test_wilson_for_a_task_and_milliseconds_for_a_policy(folder):
    results, corrupt = Results.read([folder.path])
    assert corrupt == []
    one = results.of(lambda cell: cell.seed == 0)
    assert one.honest([REACH], "uca_flow") == pytest.approx(wilson(0.8, 100))
    assert one.honest([REACH, "metaworld/door-open"], "uca_flow") == pytest.approx(wilson(0.8, 100))
    successes = np.array([[1] * n + [0] * (100 - n) for n in (80, 90)])
    assert results.honest([REACH], "uca_flow") == mean_rate([successes])  # of two trainings that differ
    assert results.milliseconds(results.tasks, "uca_flow") == (2.5, 0.5, 2)
    assert results.papers_rule([REACH], "uca_flow") == (pytest.approx(0.9), 0, 1)


def test_with_less_than_five_evaluations_the_papers_rule_has_no_number(tmp_path):
    folder = RunFolder.create(tmp_path / "run", SETTING)
    add_cell(folder, Cell(REACH, "uca_flow", 0), 50, interim=(20, 20, 20, 20))
    results, _ = Results.read([folder.path])
    assert results.papers_rule([REACH], "uca_flow") is None


def test_the_papers_rule_counts_tasks_alike_and_compares_seeds_on_the_same_tasks(tmp_path):
    """Reach, 100 %, has one seed; its wall two, 50 and 80 %. A deviation over all would be of tasks, not of seeds."""
    folder = RunFolder.create(tmp_path / "run", SETTING)
    add_cell(folder, Cell(REACH, "uca_flow", 0), 100, interim=[20] * 5)
    add_cell(folder, Cell(WALL, "uca_flow", 0), 50, interim=[10] * 5)
    add_cell(folder, Cell(WALL, "uca_flow", 1), 80, interim=[16] * 5)
    results, _ = Results.read([folder.path])
    assert results.papers_rule([WALL], "uca_flow") == pytest.approx((0.65, 0.15, 1))
    assert results.papers_rule([REACH, WALL], "uca_flow") == (pytest.approx((1 + 0.65) / 2), None, 2)
    main(["report", str(folder.path), f"--output={tmp_path}/report"])
    table = read_csv(tmp_path / "report" / "table_1.csv")
    assert table[2][5] == "82.5 (2 of 21 tasks)"
    times = read_csv(tmp_path / "report" / "table_2.csv")[2]
    assert times[6] == "2.3 +- 0.5 (2 of 21 tasks)"
    assert times[-1] == "2.3 +- 0.5 (2 of 37 tasks)"
    latex = (tmp_path / "report" / "table_1.tex").read_text()
    assert r"82.5\textsuperscript{2 of 21 tasks}" in latex


def test_an_average_says_of_how_many_tasks_it_is_also_while_cells_are_evaluated(tmp_path):
    """The fresh episodes of a cell come after its other evaluations."""
    folder = RunFolder.create(tmp_path / "run", SETTING)
    add_cell(folder, Cell(REACH, "uca_flow", 0), 50)
    (folder.cell(Cell(REACH, "uca_flow", 0)).rows / "final.csv").unlink()
    main(["report", str(folder.path), f"--output={tmp_path}/report"])
    table = read_csv(tmp_path / "report" / "table_1.csv")
    assert [row[5] for row in table[2:4]] == ["90.0 (1 of 21 tasks)", "missing"]


def test_two_results_of_a_cell_are_not_mixed(folder, tmp_path):
    """Whichever success was kept, the table would show a training that nobody has made."""
    other = RunFolder.create(tmp_path / "other", SETTING)
    add_cell(other, Cell(REACH, "uca_flow", 0), 79)
    with pytest.raises(UserError, match=r"hold different results of metaworld/reach uca_flow seed 0, .* seed 4000079"):
        Results.read([folder.path, other.path])


def test_two_last_checkpoints_of_a_cell_are_not_mixed(folder, tmp_path):
    other = RunFolder.create(tmp_path / "other", SETTING)
    cell = Cell(REACH, "uca_flow", 0)
    add_cell(other, cell, 80)
    rows = [row._replace(step=50) for row in make_rows(cell, 80, ()) if row.is_final]
    write_rows(other.cell(cell).rows / "final.csv", rows)
    with pytest.raises(UserError, match="hold different results of metaworld/reach uca_flow seed 0"):
        Results.read([folder.path, other.path])


def test_results_of_two_experts_are_not_mixed(folder, tmp_path):
    other = RunFolder.create(tmp_path / "other", SETTING)
    add_cell(other, Cell(REACH, "uca_flow", 5), 80)
    add_cell(other, Cell(WALL, "uca_flow", 5), 80)
    for run, expert in ((folder, "sha256:a"), (other, "sha256:b")):
        for path in run.path.glob("cells/metaworld/reach/*/*/cell.json"):
            write_json(path, {**json.loads(path.read_text()), "expert": expert})
    with pytest.raises(UserError, match="metaworld/reach have learned from different experts: sha256:a, sha256:b"):
        Results.read([folder.path, other.path])


def test_a_record_that_is_none(folder):
    files = folder.cell(Cell(REACH, "uca_flow", 0))
    for text in ("{}", '{"cell": ', "[]"):
        files.result.write_text(text)
        assert not files.is_finished
        with pytest.raises(UserError, match=r"cell\.json' (is not what is recorded|cannot be read)"):
            Results.read([folder.path])


@pytest.mark.parametrize("text", ["[]", '{"cells": [{}]}', '{"cells": {}}', '{"cells": [{"cell": {}}]}'])
def test_records_of_a_report_that_are_none(folder, tmp_path, text):
    main(["report", str(folder.path), f"--output={tmp_path}/report"])
    (tmp_path / "report" / "cells.json").write_text(text)
    with pytest.raises(UserError, match=r"cells\.json' is not what is recorded of a cell: it has no cell, minutes"):
        Results.read([tmp_path / "report"])


def test_what_a_killed_process_has_not_finished_is_no_result(tmp_path):
    folder = RunFolder.create(tmp_path / "run", SETTING)
    cell = Cell(REACH, "uca_flow", 0)
    rows = folder.cell(cell).rows
    rows.mkdir(parents=True)
    final = [row for row in make_rows(cell, 100, ()) if row.is_final]
    with whole_file(rows / "final.csv") as unfinished:
        write_rows(unfinished, final[:30])
    (rows / "final.csv").rename(unfinished)  # as a SIGKILL leaves it
    assert list(folder.read()) == []


def test_a_report_does_not_replace_what_it_reports(folder, tmp_path):
    main(["report", str(folder.path), f"--output={tmp_path}/report"])
    before = {path: path.read_bytes() for path in (tmp_path / "report").iterdir()}
    with pytest.raises(UserError, match="is what is to be reported: its rows would be replaced"):
        main(["report", f"{tmp_path}/report", f"--output={tmp_path}/run/../report", "--policies=uca_flow"])
    assert {path: path.read_bytes() for path in (tmp_path / "report").iterdir()} == before


def test_a_report_does_not_replace_a_runs_setting(folder, tmp_path):
    other = RunFolder.create(tmp_path / "other", replace(SETTING, batch_size=9))
    add_cell(other, Cell(REACH, "uca_flow", 0), 79)
    before = (other.path / "setting.json").read_bytes()
    with pytest.raises(UserError, match="is the folder of a run, whose setting would be replaced"):
        main(["report", str(folder.path), f"--output={other.path}"])
    assert (other.path / "setting.json").read_bytes() == before


def contents(path):
    return {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}


def test_a_report_does_not_replace_rows_that_no_run_holds(folder, tmp_path):
    """Its run may be gone."""
    output = tmp_path / "report"
    main(["report", str(folder.path), f"--output={output}"])
    before = contents(output)
    other = RunFolder.create(tmp_path / "other", SETTING)
    add_cell(other, Cell(WALL, "uca_flow", 0), 100)
    lost = rf"--output '.*/report' holds results of {REACH} adaln seed 0 that are not in .*/other: choose another"
    with pytest.raises(UserError, match=lost):
        main(["report", str(other.path), f"--output={output}"])
    shutil.rmtree(folder.cell(Cell(REACH, "adaln", 0)).path)
    add_cell(folder, Cell(REACH, "adaln", 0), 61)  # trained anew
    with pytest.raises(UserError, match=rf"holds results of {REACH} adaln seed 0 that are not in"):
        main(["report", str(folder.path), f"--output={output}", "--policies=uca_flow"])
    assert contents(output) == before


def test_a_report_grows_with_its_run(folder, tmp_path):
    main(["report", str(folder.path), f"--output={tmp_path}/report"])
    add_cell(folder, Cell(REACH, "uca_flow", 2), 70)
    main(["report", str(folder.path), f"--output={tmp_path}/report"])
    main(["report", str(folder.path), f"--output={tmp_path}/report", "--policies=adaln"])


def test_a_report_does_not_mix_with_other_things(folder, tmp_path):
    output = tmp_path / "mine"
    output.mkdir()
    main(["report", str(folder.path), f"--output={output}"])  # an empty folder will do
    kept = output / "episodes_of_mine.csv"
    kept.touch()
    main(["report", str(folder.path), f"--output={output}"])
    assert kept.exists()
    (output / "cells.json").unlink()
    with pytest.raises(UserError, match=r"--output '.*/mine' holds other things than a report: choose a new or empty"):
        main(["report", str(folder.path), f"--output={output}"])


@pytest.mark.parametrize("n_written", [0, 1, 2])
def test_a_report_that_was_interrupted_is_made_again(folder, tmp_path, monkeypatch, n_written):
    files = iter(range(n_written))

    def until_the_disk_is_full(write):
        def write_next(*args):
            if next(files, None) is None:
                raise OSError(errno.ENOSPC, "No space left on device")
            write(*args)

        return write_next

    with monkeypatch.context() as patch:
        for name in ("write_json", "write_rows"):
            patch.setattr(results, name, until_the_disk_is_full(getattr(results, name)))
        with pytest.raises(UserError, match="No space left on device"):
            main(["report", str(folder.path), f"--output={tmp_path}/report"])
    main(["report", str(folder.path), f"--output={tmp_path}/report"])


def test_a_report_leaves_no_figures_of_the_one_before(folder, tmp_path):
    output = tmp_path / "report"
    main(["report", str(folder.path), f"--output={output}"])
    (output / "rollouts.png").touch()
    assert (output / "success_over_minutes.png").exists()
    main(["report", str(folder.path), f"--output={output}", "--policies=adaln"])
    assert {path.stem for path in output.glob("*.png")} == {path.stem for path in output.glob("*.svg")}
    assert not (output / "success_over_minutes.png").exists()
    assert not (output / "rollouts.png").exists()


def test_tuning_has_other_episodes_and_is_left_out_beside_the_table(tmp_path, capsys):
    folder = RunFolder.create(tmp_path / "run", SETTING)
    add_cell(folder, Cell(REACH, "uca_flow", 0), 80)
    tuning = RunFolder.create(tmp_path / "tuning", SETTING)
    cell = Cell(REACH, "uca_flow", FIRST_TUNING_SEED)
    add_cell(tuning, cell, 60)
    main(["report", str(folder.path), str(tuning.path), f"--output={tmp_path}/report"])
    assert "warning: training seeds for tuning (100) are left out" in capsys.readouterr().err
    _, row = read_csv(tmp_path / "report" / "tasks.csv")
    assert row[2] == "0"
    assert row[-1].startswith("80.0 [")
    main(["report", str(tuning.path), f"--output={tmp_path}/tuned"])
    assert "warning" not in capsys.readouterr().err
    assert read_csv(tmp_path / "tuned" / "tasks.csv")[1][2] == "100"


@pytest.mark.parametrize(
    ("interim", "minutes"),
    [((0, 18, 19, 20, 20, 20), 3.0), ((19, 0, 0, 0, 0, 0), 1.0), ((18, 18, 18, 18, 18, 18), None)],
)
def test_minutes_until_the_papers_success(tmp_path, interim, minutes):
    """Six minutes of training, an evaluation each minute; 19 of 20 are the first that are at least 92.4 %."""
    folder = RunFolder.create(tmp_path / "run", SETTING)
    cell = Cell(REACH, "uca_flow", 0)
    add_cell(folder, cell, 50, interim)
    results, _ = Results.read([folder.path])
    assert results.minutes_until(cell, goal(REACH).mean / 100) == minutes


def test_success_over_minutes(folder, tmp_path):
    """Two seeds of six minutes, of which one takes twice as long: an evaluation every 1.5 minutes in the mean."""
    file = folder.cell(Cell(REACH, "uca_flow", 1)).result
    record = json.loads(file.read_text())
    write_json(file, {**record, "minutes": {"training": 12.0}})
    results, _ = Results.read([folder.path])
    curve = results.curve_over_minutes(REACH, "uca_flow")
    assert curve == {1.5: [0, 0], 3: [1, 1], 4.5: [1, 1], 6: [1, 1], 7.5: [1, 1], 9: [0.5, 0.5]}
    assert results.curve_over_minutes(WALL, "adaln") == {}


def texts_of(figure, tmp_path):
    """What is written in a figure of a report."""
    return re.findall(r"<text[^>]*>([^<]*)</text>", (tmp_path / "report" / f"{figure}.svg").read_text())


def test_policies_are_compared_on_what_all_have_learned(folder, tmp_path):
    """Of two tasks and two seeds AdaLN has one task and one seed."""
    main(["report", str(folder.path), f"--output={tmp_path}/report"])
    assert {"UCA-Flow, 1 of 1", f"{POLICIES['adaln'].title}, 1 of 1"} <= set(texts_of("minutes_to_success", tmp_path))
    assert REACH in texts_of("success_over_minutes", tmp_path)
    assert WALL not in texts_of("success_over_minutes", tmp_path)


def test_one_policy_is_shown_on_all_it_has_learned(tmp_path):
    folder = RunFolder.create(tmp_path / "run", SETTING)
    add_cell(folder, Cell(REACH, "uca_flow", 0), 80)
    add_cell(folder, Cell(WALL, "uca_flow", 0), 0, interim=(0, 0, 0, 0, 0, 0))
    main(["report", str(folder.path), f"--output={tmp_path}/report"])
    assert "UCA-Flow, 1 of 2" in texts_of("minutes_to_success", tmp_path)
    assert not (tmp_path / "report" / "success_over_minutes.svg").exists()


def test_chosen_policies_are_reported_as_if_there_were_no_others(folder, tmp_path):
    main(["report", str(folder.path), f"--output={tmp_path}/report", "--policies=uca_flow"])
    assert "UCA-Flow, 4 of 4" in texts_of("minutes_to_success", tmp_path)
    assert {row[1] for row in read_csv(tmp_path / "report" / "tasks.csv")[1:]} == {"uca_flow"}
    with pytest.raises(UserError, match=r"There are no results yet in .* for dp3, mp1"):
        main(["report", str(folder.path), f"--output={tmp_path}/other", "--policies=dp3,mp1"])


def test_goals():
    """Printed for the task, for its group, and not at all."""
    goals = {"metaworld/shelf-place": 74.0, "metaworld/reach": 92.4, "adroit/pen": 63.0, "metaworld/basketball": None}
    assert {task: getattr(goal(task), "mean", None) for task in goals} == goals


def test_differences_are_paired(folder, tmp_path):
    """Both have only seed 0's episodes on reach: 80 and 60 of the same 100."""
    main(["report", str(folder.path), f"--output={tmp_path}/report"])
    _, row = read_csv(tmp_path / "report" / "differences.csv")
    assert row[:2] == ["UCA-Flow minus - Unified/a: AdaLN", "1"]
    assert row[2].startswith("20.0 [")
    assert row[3] == "UCA-Flow is better"


def test_a_reports_folder_can_be_reported(folder, tmp_path):
    main(["report", str(folder.path), f"--output={tmp_path}/first"])
    main(["report", str(tmp_path / "first"), f"--output={tmp_path}/second", "--html"])
    for name in (
        "episodes_uca_flow_0.csv",
        "episodes_adaln_0.csv",
        "cells.json",
        "report.md",
        "table_3.tex",
        "success_over_epochs.svg",
    ):
        assert (tmp_path / "first" / name).read_text() == (tmp_path / "second" / name).read_text()
    together, _ = Results.read([folder.path, tmp_path / "first"])
    assert together.rows == Results.read([folder.path])[0].rows
    main(["report", str(folder.path), f"--output={tmp_path}/first", "--policies=adaln"])
    assert [path.name for path in (tmp_path / "first").glob("*episodes*.csv")] == ["episodes_adaln_0.csv"]


class Page(HTMLParser):
    """Checks that elements close as they open, and collects what they refer to."""

    def __init__(self):
        super().__init__()
        self.open, self.references, self.ids, self.n_svg = [], [], [], 0

    def handle_starttag(self, tag, attributes):
        self.n_svg += tag == "svg"
        self.references += [value for name, value in attributes if name in ("src", "href", "xlink:href")]
        self.ids += [value for name, value in attributes if name == "id"]
        if tag not in ("meta", "link", "br"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.references += [value for name, value in attributes if name in ("src", "href", "xlink:href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_self_contained(folder, tmp_path):
    main(["report", str(folder.path), f"--output={tmp_path}/report", "--html"])
    text = (tmp_path / "report" / "report.html").read_text()
    page = Page()
    page.feed(text)
    assert page.open == []
    assert page.n_svg == 5
    assert all(reference.startswith("#") for reference in page.references)
    assert len(set(page.ids)) == len(page.ids)
    assert "<script" not in text
    for figure in FIGURES:
        assert (tmp_path / "report" / f"{figure}.png").read_bytes().startswith(b"\x89PNG")


@needs_browser
def test_a_browser_shows_the_page(folder, tmp_path):
    """Text, and the figures in the policies' colours."""
    main(["report", str(folder.path), f"--output={tmp_path}/report", "--html"])
    page = (tmp_path / "report" / "report.html").as_uri()
    with browser(page, tmp_path / "user", (1000, 2400)) as picture:

        def n_pixels(colour: str) -> int:
            rgb = [int(colour[start : start + 2], 16) for start in (1, 3, 5)]
            return int((picture() == rgb).all(axis=-1).sum())

        wait_until(lambda: min(n_pixels(COLOURS[policy]) for policy in ("uca_flow", "adaln")) > 500, 120)
        dark = picture().max(axis=-1) < 100
    assert dark[:, :900].any(axis=1).mean() > 0.2  # lines of text from top to bottom
    assert dark[-200:].any()


def test_a_corrupt_row_is_named_and_the_rest_is_reported(folder, tmp_path, capsys):
    path = folder.cell(Cell(REACH, "adaln", 0)).rows / "final.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:5], lines[5][:20], *lines[6:]]))
    main(["report", str(folder.path), f"--output={tmp_path}/report"])
    assert capsys.readouterr().err.startswith(f"warning: {path}, line 6 is left out: it has too many or too few")
    assert "table_1.csv" in {file.name for file in (tmp_path / "report").iterdir()}


def test_results_of_two_settings_are_not_mixed(folder, tmp_path):
    other = RunFolder.create(tmp_path / "other", replace(SETTING, batch_size=4))
    with pytest.raises(UserError, match="were made with different settings: batch_size was 8, now it is 4"):
        Results.read([folder.path, other.path])


def test_a_run_without_results(tmp_path):
    folder = RunFolder.create(tmp_path / "run", SETTING)
    with pytest.raises(UserError, match="There are no results yet"):
        main(["report", str(folder.path), f"--output={tmp_path}/report"])
    assert not (tmp_path / "report").exists()


def test_a_difference_names_who_is_better(tmp_path):
    folder = RunFolder.create(tmp_path / "run", SETTING)
    for policy, n_final in (("uca_flow", 60), ("adaln", 80), ("mp1", 61)):
        add_cell(folder, Cell(REACH, policy, 0), n_final)
    main(["report", str(folder.path), f"--output={tmp_path / 'report'}"])
    verdicts = {row[0]: row[-1] for row in read_csv(tmp_path / "report" / "differences.csv")}
    assert verdicts["UCA-Flow minus - Unified/a: AdaLN"] == "- Unified/a: AdaLN is better"
    assert verdicts["UCA-Flow minus MP1"] == "undecided"
