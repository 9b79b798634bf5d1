"""Uploading to the Hugging Face Hub: what is on the disk is whole, whatever the network does."""

import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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


def upload_command(repo_id: str | None, folder: Path, path_in_repo: str = ".") -> str:
    """The command that uploads a folder to a model repository."""
    return shlex.join(["hf", "upload", repo_id or "user/name", str(folder), path_in_repo])
