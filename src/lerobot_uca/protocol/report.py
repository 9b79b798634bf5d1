"""`lerobot-uca-benchmark report`: tables and figures of one or several runs."""

import html
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from lerobot_uca.errors import UserError
from lerobot_uca.protocol import rollouts
from lerobot_uca.protocol.cells import POLICIES
from lerobot_uca.protocol.figures import CAPTIONS, draw, remove
from lerobot_uca.protocol.folder import RECORDS, SETTING
from lerobot_uca.protocol.results import Results
from lerobot_uca.protocol.tables import TABLES, setting_of

STYLE = """\
body { font: 16px/1.5 system-ui, sans-serif; max-width: 75rem; margin: 2rem auto; padding: 0 1rem; color: #222 }
section { overflow-x: auto } table { border-collapse: collapse; font-size: 0.8rem }
th, td { padding: 0.25rem 0.4rem; text-align: left; vertical-align: top; border-bottom: 1px solid #ddd }
tbody tr:hover { background: #f3f6fa } svg { max-width: 100%; height: auto }
"""


def report(
    runs: Sequence[Path],
    output: Path,
    *,
    as_html: bool,
    policies: Sequence[str] = tuple(POLICIES),
    rollouts_of: Sequence[str] = (),
) -> str:
    """Write tables (Markdown, CSV, LaTeX), figures (PNG, SVG) and the results themselves; the tables as Markdown.

    Args:
        runs: folders of runs or reports.
        output: folder to write.
        as_html: whether to write one page as well.
        policies: those to report.
        rollouts_of: tasks of which an episode of each policy is shown; for that it is run again.

    Raises:
        UserError: if there are no results, or no checkpoint for rollouts, or the folder cannot be written, is itself
            reported, or holds anything but an earlier report of the same results.
    """
    if output.resolve() in [run.resolve() for run in runs]:
        raise UserError(f"--output '{output}' is what is to be reported: its rows would be replaced. Choose another.")
    if (output / "cells").exists():
        raise UserError(f"--output '{output}' is the folder of a run, whose setting would be replaced. Choose another.")
    results, corrupt = Results.read(runs)
    _check_output(output, results, runs)
    for line in corrupt:
        print(f"warning: {line}", file=sys.stderr)
    results, tuning = results.of(lambda cell: cell.policy in policies).without_tuning()
    if tuning:
        print(
            f"warning: training seeds for tuning ({', '.join(map(str, tuning))}) are left out: "
            "their episodes are others than the other seeds'.",
            file=sys.stderr,
        )
    if not results.rows:
        raise UserError(f"There are no results yet in {', '.join(map(str, runs))} for {', '.join(policies)}.")
    strips = rollouts.strips_of(runs, results, rollouts_of) if rollouts_of else []
    tables = [make(results) for make in TABLES]
    markdown = "\n".join(table.markdown() for table in tables)
    try:
        output.mkdir(parents=True, exist_ok=True)
        results.write(output)
        (output / "report.md").write_text(markdown, encoding="utf-8")
        for table in tables:
            (output / f"{table.name}.csv").write_text(table.csv(), encoding="utf-8")
            (output / f"{table.name}.tex").write_text(table.latex(), encoding="utf-8")
        figures = draw(results, output)
        if strips:
            figures.append(rollouts.draw(strips, output))
        else:
            remove(output / "rollouts")
        if as_html:
            page = _page(results, [table.html() for table in tables], figures)
            (output / "report.html").write_text(page, encoding="utf-8")
    except OSError as error:
        raise UserError(f"--output '{output}' cannot be written: {error}") from error
    return markdown


def _check_output(output: Path, results: Results, runs: Sequence[Path]) -> None:
    """Refuse a folder of other things, and a report with rows that no run holds any more: it may be all that is left.

    Args:
        output: folder to write, there or not.
        results: of the runs, those of all policies.
        runs: folders of runs or reports.
    """
    try:
        if not output.is_dir() or not any(output.iterdir()):
            return
    except OSError as error:
        raise UserError(f"--output '{output}' cannot be written: {error}") from error
    if {each.name for each in output.iterdir()} == {RECORDS}:  # of one that was interrupted at once
        return
    if not all((output / name).is_file() for name in (SETTING, RECORDS)):
        raise UserError(f"--output '{output}' holds other things than a report: choose a new or empty folder.")
    kept = {tuple(row.as_text()) for row in results.rows}
    for row in Results.read([output])[0].rows:
        if tuple(row.as_text()) not in kept:
            raise UserError(
                f"--output '{output}' holds results of {row.cell} that are not in {', '.join(map(str, runs))}: choose "
                "another --output."
            )


def _page(results: Results, tables: Sequence[str], figures: Sequence[Path]) -> str:
    """One page that needs nothing else."""
    pictures = [
        f"<figure>{_inline(path, index)}<figcaption>{CAPTIONS[path.stem]}</figcaption></figure>"
        for index, path in enumerate(figures)
    ]
    n_cells = len(results.records)
    body = "\n".join([tables[0], *pictures, *tables[1:]])
    return f"""<!doctype html>
<html lang="en">
<head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>UCA-Flow: results beside the paper's</title>
<style>{STYLE}</style></head>
<body>
<h1>UCA-Flow: results beside the paper's</h1>
<p>{n_cells} trained cells (a cell is one policy on one task with one training seed), {len(results.rows)} episodes.
{html.escape(setting_of(results))}</p>
{body}
</body></html>
"""


def _inline(path: Path, index: int) -> str:
    """An SVG as a part of a page: without its XML header, with ids that no other figure has."""
    text = path.read_text(encoding="utf-8")
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\bid="', f'id="f{index}-', text)
    return re.sub(r'(url\(#|href="#)', rf"\1f{index}-", text)
