"""The paper's tables from results: ours beside the paper's, what is missing shown as missing."""

import csv
import html
import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from lerobot_uca.protocol import paper
from lerobot_uca.protocol.cells import PAPER_GROUPS, POLICIES, SUITES
from lerobot_uca.protocol.intervals import Estimate
from lerobot_uca.protocol.results import Results, Spread

MISSING = "missing"
RULES = (
    "Each policy has three lines: the paper's number; ours by the paper's rule, the mean of the best five evaluations "
    "during training, of each seed, which selects on the episodes it reports; ours by the honest rule, the last "
    "checkpoint in fresh episodes, with a 95 % interval (Wilson's; of a mean, from how seeds and episodes differ "
    "within each task). Tasks count alike, however many seeds they have; +- is the standard deviation over the seeds "
    "that have all of the tasks, where there are several."
)


@dataclass(frozen=True)
class Table:
    """Text in rows and columns."""

    name: str
    """The name of its files."""
    title: str
    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        """The table in Markdown, with its title and caption."""
        lines = [" | ".join(row) for row in (self.header, ["---"] * len(self.header), *self.rows)]
        table = "\n".join(f"| {line} |" for line in lines)
        return f"### {self.title}\n\n{table}\n\n{self.caption}\n"

    def csv(self) -> str:
        """Without title and caption."""
        file = io.StringIO()
        csv.writer(file, lineterminator="\n").writerows([self.header, *self.rows])
        return file.getvalue()

    def latex(self) -> str:
        """The table in LaTeX, as wide as the page, with the packages booktabs and graphicx."""
        title = re.sub(r"^Table \d: ", "", self.title)  # LaTeX numbers tables itself
        title = title[0].upper() + title[1:]
        lines = [" & ".join(map(_latex_cell, row)) + r" \\" for row in (self.header, *self.rows)]
        return "\n".join(
            [
                r"\begin{table*}",
                rf"\caption{{{_latex(title)}. {_latex(self.caption)}}}",
                r"\resizebox{\textwidth}{!}{%",
                rf"\begin{{tabular}}{{{'l' * 2}{'c' * (len(self.header) - 2)}}}",
                r"\toprule",
                lines[0],
                r"\midrule",
                *lines[1:],
                r"\bottomrule",
                r"\end{tabular}%",
                "}",
                r"\end{table*}",
                "",
            ]
        )

    def html(self) -> str:
        """The table as a section of HTML."""
        head, *body = (
            "".join(f"<{kind}>{_html(text)}</{kind}>" for text in row)
            for kind, row in [("th", self.header), *(("td", row) for row in self.rows)]
        )
        rows = "\n".join(f"<tr>{row}</tr>" for row in body)
        return (
            f"<section><h2>{_html(self.title)}</h2>\n<table><thead><tr>{head}</tr></thead>\n<tbody>\n{rows}\n"
            f"</tbody></table>\n<p>{_html(self.caption)}</p></section>"
        )


def _columns() -> dict[str, tuple[str, ...]]:
    """Tasks by column of Tables 1 and 2."""
    adroit = {task.split("/")[1]: (task,) for task in PAPER_GROUPS["adroit"]}
    groups = {group: tasks for group, tasks in PAPER_GROUPS.items() if group != "adroit"}
    return {**adroit, **groups, "average": SUITES["paper"]}


COLUMNS = _columns()
TITLES = {
    **{name: f"Adroit {name}" for name in ("hammer", "door", "pen")},
    **{
        group: f"{group.replace('_', ' ')} ({len(COLUMNS[group])})" for group in ("easy", "medium", "hard", "very_hard")
    },
    "average": "average (37)",
}


def setting_of(results: Results) -> str:
    """The part of a table's caption that names its setting."""
    setting = results.setting
    ran_on = "; ".join(results.hardware())
    return f"Setting '{setting.name}': {setting.description}.{f' Made on: {ran_on}.' if ran_on else ''}"


def success_table(results: Results) -> Table:
    """Table 1."""
    policies = [policy for policy in POLICIES if policy in paper.SUCCESS or policy in results.policies]
    rows = [row for policy in policies for row in _success_rows(results, policy, COLUMNS, paper.SUCCESS)]
    header = ["policy", "", *TITLES.values()]
    caption = f"{RULES} UCA-Flow's printed columns average to 86.4, not to the printed 88.2. {setting_of(results)}"
    return Table("table_1", "Table 1: success [%]", caption, header, rows)


def ablation_table(results: Results) -> Table:
    """Table 3."""
    columns = {task: (task,) for task in SUITES["ablation"]} | {"average": SUITES["ablation"]}
    rows = [row for policy in paper.ABLATION for row in _success_rows(results, policy, columns, paper.ABLATION)]
    header = ["policy", "", *(task.split("/")[1] for task in SUITES["ablation"]), "average (8)"]
    caption = f"{RULES} The paper prints no average. {setting_of(results)}"
    return Table("table_3", "Table 3: success of the ablations [%]", caption, header, rows)


def _success_rows(
    results: Results,
    policy: str,
    columns: dict[str, tuple[str, ...]],
    printed: dict[str, dict[str, paper.Printed]],
) -> list[list[str]]:
    title = POLICIES[policy].title
    papers = [_printed(printed.get(policy, {}).get(column)) for column in columns]
    by_papers_rule = [_spread(results.papers_rule(tasks, policy), 100, tasks) for tasks in columns.values()]
    honest = [
        _of_tasks(_interval(results.honest(tasks, policy)), results.n_evaluated(tasks, policy), tasks)
        for tasks in columns.values()
    ]
    return [[title, "paper", *papers], ["", "ours, paper's rule", *by_papers_rule], ["", "ours, honest", *honest]]


def inference_table(results: Results) -> Table:
    """Table 2."""
    rows = []
    for policy in [policy for policy in POLICIES if policy in paper.MILLISECONDS]:
        ours = [_spread(results.milliseconds(tasks, policy), 1, tasks) for tasks in COLUMNS.values()]
        papers = [_printed(paper.MILLISECONDS[policy].get(column)) for column in COLUMNS]
        calls = paper.NETWORK_CALLS[policy]
        rows += [[POLICIES[policy].title, "paper", str(calls), *papers], ["", "ours", str(calls), *ours]]
    caption = (
        "Milliseconds from an observation to a chunk of actions, one sample. The paper's on an RTX A5000 while three "
        "seeds run; ours while the other cells run, mean and deviation over cells of their medians. "
        f"{setting_of(results)}"
    )
    return Table("table_2", "Table 2: inference [ms]", caption, ["policy", "", "NFE", *TITLES.values()], rows)


def difference_table(results: Results) -> Table:
    """The orders of policies that hold."""
    first, *others = results.policies or ["uca_flow"]
    rows = []
    for other in others:
        found = results.difference(first, other, results.tasks)
        if found is None:
            continue
        estimate, tasks = found
        verdict = (
            f"{POLICIES[first if estimate.mean > 0 else other].title} is better" if estimate.is_decided else "undecided"
        )
        rows.append(
            [f"{POLICIES[first].title} minus {POLICIES[other].title}", str(len(tasks)), _interval(estimate), verdict]
        )
    caption = (
        "Paired by task, training seed and episode, over the tasks that both policies have; honest rule, points of "
        f"success with a 95 % interval, Student's. Undecided where the interval holds 0. {setting_of(results)}"
    )
    return Table(
        "differences", "Differences between policies", caption, ["difference", "tasks", "points", "verdict"], rows
    )


def task_table(results: Results) -> Table:
    """Every task."""
    rows = []
    for task in results.tasks:
        for policy in results.policies:
            honest = results.honest((task,), policy)
            rule = results.papers_rule((task,), policy)
            seeds = results.seeds(task, policy)
            if honest or rule:
                printed = paper.of_task(task, policy)
                names = ", ".join(map(str, seeds))
                rows.append([task, policy, names, _printed(printed), _spread(rule, 100, (task,)), _interval(honest)])
    header = ["task", "policy", "seeds", "paper", "ours, paper's rule", "ours, honest"]
    return Table("tasks", "Every task: success [%]", setting_of(results), header, rows)


TABLES: tuple[Callable[[Results], Table], ...] = (
    success_table,
    inference_table,
    ablation_table,
    difference_table,
    task_table,
)


def _printed(number: paper.Printed | None) -> str:
    if number is None:
        return "-"
    n_digits = 0 if number.mean.is_integer() and number.spread.is_integer() else 1
    return f"{number.mean:.{n_digits}f} +- {number.spread:.{n_digits}f}"


def _spread(value: Spread | None, scale: float, tasks: Sequence[str]) -> str:
    if value is None:
        return MISSING
    deviation = "" if value.deviation is None else f" +- {scale * value.deviation:.1f}"
    return _of_tasks(f"{scale * value.mean:.1f}{deviation}", value.n_tasks, tasks)


def _interval(estimate: Estimate | None) -> str:
    if estimate is None:
        return MISSING
    mean, low, high = (100 * value for value in estimate)
    return f"{mean:.1f} [{low:.1f}, {high:.1f}]"


def _of_tasks(text: str, n_there: int, tasks: Sequence[str]) -> str:
    """The text and, where some of several tasks are missing, of how many it is."""
    return text if text == MISSING or n_there == len(tasks) else f"{text} ({n_there} of {len(tasks)} tasks)"


def _html(text: str) -> str:
    return html.escape(text).replace("+-", "±")


_LATEX = str.maketrans(
    {character: rf"\{character}" for character in "%_&#{}$"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": "$<$", ">": "$>$"}
)


def _latex(text: str) -> str:
    return text.translate(_LATEX).replace("+-", r"$\pm$")


def _latex_cell(text: str) -> str:
    """A cell, narrow: what follows a number is small beside it, how many tasks it is of above it."""
    found = re.fullmatch(r"(-?[\d.]+)(?: \+- ([\d.]+)| (\[.*\]))?(?: \((.* tasks)\))?", text)
    if not found:
        return _latex(text)
    number, deviation, interval, tasks = found.groups()
    beside = rf"\pm {deviation}" if deviation else interval
    return (rf"${number}_{{{beside}}}$" if beside else number) + (rf"\textsuperscript{{{tasks}}}" if tasks else "")
