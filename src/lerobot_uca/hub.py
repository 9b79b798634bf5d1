"""Uploading to the Hugging Face Hub: what is on the disk is whole, whatever the network does."""

import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
from huggingface_hub.errors import HfHubHTTPError, HFValidationError, OfflineModeIsEnabled

from lerobot_uca.errors import UserError

UPLOAD_ERRORS = (HfHubHTTPError, HFValidationError, OfflineModeIsEnabled, httpx.HTTPError, OSError)


@contextmanager
def uploading(what: str, retry: str) -> Iterator[None]:
    """Report a failed upload in one line.

    Args:
        what: is complete on the disk and was to be uploaded.
        retry: the command that uploads it.

    Raises:
        UserError: if the upload fails.
    """
    try:
        yield
    except UPLOAD_ERRORS as error:
        reason = " ".join(str(error).split())
        raise UserError(f"{what} is complete but could not be uploaded: {reason} To upload it: {retry}") from error


def push_dataset(dataset: Any, *, private: bool | None, tags: list[str]) -> None:
    """Upload a LeRobot dataset.

    Raises:
        UserError: if it fails; it says how to upload the dataset, which stays.
    """
    opened = f"LeRobotDataset('{dataset.repo_id}', root='{dataset.root}')"
    retry = f"{opened}.push_to_hub(private={private}, tags={tags}) in Python"
    with uploading(f"The dataset in '{dataset.root}'", retry):
        dataset.push_to_hub(private=private, tags=tags)


def upload_command(repo_id: str, folder: Path, path_in_repo: str = ".", *, private: bool | None) -> str:
    """The command that uploads a folder to a model repository, which may have to be made first: as private as asked."""
    how = {True: ["--private"], False: ["--no-private"], None: []}[private]
    return shlex.join(["hf", "upload", repo_id, str(folder), path_in_repo, *how])
