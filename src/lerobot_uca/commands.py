"""The console commands. Imports are put off, because each process of `lerobot-uca-collect` loads this module again."""

import sys

from lerobot_uca.processes import end_by_signals


def collect() -> None:
    """`lerobot-uca-collect`."""
    end_by_signals()
    from lerobot.utils.import_utils import register_third_party_plugins

    from lerobot_uca.data.collect import run

    register_third_party_plugins()
    # LeRobot's parser wants a value for every option; a bare flag is what people type.
    bare = {"--overwrite", "--push_to_hub", "--private"}
    followed_by_value = [*(not argument.startswith("-") for argument in sys.argv[2:]), False]
    sys.argv[1:] = [
        f"{argument}=true" if argument in bare and not has_value else argument
        for argument, has_value in zip(sys.argv[1:], followed_by_value, strict=False)
    ]
    run()


def convert() -> None:
    """`lerobot-uca-convert`."""
    end_by_signals()
    from lerobot.utils.import_utils import register_third_party_plugins

    from lerobot_uca.data.convert import run

    register_third_party_plugins()
    run()


def export() -> None:
    """`lerobot-uca-export`."""
    end_by_signals()
    from lerobot.utils.import_utils import register_third_party_plugins

    from lerobot_uca.deploy.export import run

    register_third_party_plugins()
    run()


def calibrate() -> None:
    """`lerobot-uca-calibrate`."""
    end_by_signals()
    from lerobot.utils.import_utils import register_third_party_plugins

    from lerobot_uca.robots.calibrate import run

    register_third_party_plugins()
    run()


def edit_dataset() -> None:
    """`lerobot-uca-edit-dataset`."""
    end_by_signals()
    from lerobot_uca.data.edit_dataset import run

    run()


def benchmark() -> None:
    """`lerobot-uca-benchmark`."""
    from lerobot_uca.errors import UserError
    from lerobot_uca.processes import end_by_signals
    from lerobot_uca.protocol.command import main

    end_by_signals()
    try:
        main()
    except UserError as error:
        sys.exit(f"error: {error}")


def ur5e_sim() -> None:
    """`lerobot-uca-ur5e-sim`."""
    from lerobot_uca.errors import UserError
    from lerobot_uca.robots.ur5e.sim.command import main

    try:
        main()
    except UserError as error:
        sys.exit(f"error: {error}")


def saliency() -> None:
    """`lerobot-uca-saliency`."""
    from lerobot.utils.import_utils import register_third_party_plugins

    from lerobot_uca.errors import UserError
    from lerobot_uca.visual.saliency import main

    register_third_party_plugins()
    try:
        main()
    except UserError as error:
        sys.exit(f"error: {error}")


def view() -> None:
    """`lerobot-uca-view`."""
    end_by_signals()
    from lerobot.utils.import_utils import register_third_party_plugins

    from lerobot_uca.visual.view import run

    register_third_party_plugins()
    run()
