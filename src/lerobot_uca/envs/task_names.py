"""The tasks that a user's `--env.task=` means."""

from collections.abc import Collection, Mapping
from difflib import SequenceMatcher

from lerobot_uca.errors import UserError


def resolve_tasks(
    spec: str | None, *, benchmark: str, tasks: Collection[str], groups: Mapping[str, tuple[str, ...]]
) -> dict[str, tuple[str, ...]]:
    """Task names for each comma-separated entry of `spec`, which is a task or a group: {entry: tasks}.

    Raises:
        UserError: for an empty or unknown entry; it lists the valid ones, the most similar first.
    """
    entries = [entry.strip() for entry in (spec or "").split(",") if entry.strip()]
    if not entries:
        raise UserError(f"No task given. {_valid(benchmark, tasks, groups)}")
    for entry in entries:
        if entry not in groups and entry not in tasks:
            nearest_first = sorted(tasks, key=lambda task: -SequenceMatcher(None, entry, task).ratio())
            raise UserError(f"Unknown task '{entry}'. {_valid(benchmark, nearest_first, groups)}")
    return {entry: groups.get(entry, (entry,)) for entry in entries}


def only_task(spec: str, resolved: Mapping[str, tuple[str, ...]]) -> str:
    """The one task that `resolve_tasks` has found for `spec`.

    Raises:
        UserError: if there are several.
    """
    task, *others = (task for tasks in resolved.values() for task in tasks)
    if others:
        raise UserError(f"An environment has one task, got '{spec}', which stands for several.")
    return task


def _valid(benchmark: str, tasks: Collection[str], groups: Mapping[str, tuple[str, ...]]) -> str:
    return f"{benchmark} tasks: {', '.join(tasks)}; groups: {', '.join(groups)}."
