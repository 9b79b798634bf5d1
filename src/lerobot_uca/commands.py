"""The console commands. Imports are put off, because each process of `lerobot-uca-collect` loads this module again."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from lerobot_uca.processes import end_by_signals


def _begin() -> None:
    """Let signals end the command cleanly, and LeRobot load its plugins: this one reports user errors in one line."""
    end_by_signals()
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()


@contextmanager
def _mistakes_in_one_line() -> Iterator[None]:
    """For the commands that do not load the plugin, which reports them so."""
    from lerobot_uca.errors import UserError

    try:
        yield
    except UserError as error:
        sys.exit(f"error: {error}")


def _read_bare_flags() -> None:
    """LeRobot's parser wants a value for every option; a bare flag is what people type."""
    bare = {"--overwrite", "--push_to_hub", "--private"}
    followed_by_value = [*(not argument.startswith("-") for argument in sys.argv[2:]), False]
    sys.argv[1:] = [
        f"{argument}=true" if argument in bare and not has_value else argument
        for argument, has_value in zip(sys.argv[1:], followed_by_value, strict=False)
    ]


def collect() -> None:
    """`lerobot-uca-collect`."""
    _begin()
    from lerobot_uca.data.collect import run

    _read_bare_flags()
    run()


def convert() -> None:
    """`lerobot-uca-convert`."""
    _begin()
    from lerobot_uca.data.convert import run

    _read_bare_flags()
    run()


def export() -> None:
    """`lerobot-uca-export`."""
    _begin()
    from lerobot_uca.deploy.export import run

    run()


def calibrate() -> None:
    """`lerobot-uca-calibrate`."""
    _begin()
    from lerobot_uca.robots.calibrate import run

    run()


def edit_dataset() -> None:
    """`lerobot-uca-edit-dataset`."""
    _begin()
    from lerobot_uca.data.edit_dataset import run

    run()


def saliency() -> None:
    """`lerobot-uca-saliency`."""
    _begin()
    from lerobot_uca.visual.saliency import main

    main()


def view() -> None:
    """`lerobot-uca-view`."""
    _begin()
    from lerobot_uca.robots.realsense import register
    from lerobot_uca.visual.view import run

    register()
    run()


# These two need no LeRobot, which takes seconds to import. ------------------------------------------------------------


def benchmark() -> None:
    """`lerobot-uca-benchmark`."""
    end_by_signals()
    from lerobot_uca.protocol.command import main

    with _mistakes_in_one_line():
        main()


def ur5e_sim() -> None:
    """`lerobot-uca-ur5e-sim`."""
    end_by_signals()
    from lerobot_uca.robots.ur5e.sim.command import main

    with _mistakes_in_one_line():
        main()
