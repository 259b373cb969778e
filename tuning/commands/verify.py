"""`drive-tune verify`: check whether a certificate is unchanged."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tuning.commands.options import REFUSED, Json, errors_as_exit_codes, fail, print_json


def verify(
    file: Annotated[
        Path, typer.Argument(help="certificate.json, stepper-certificate.json or report.html of a tuning.")
    ],
    json: Json = False,
) -> None:
    """Check whether a certificate or its report was changed since it was written; exit code 1 if it was.

    The hash shows a change; it is not a signature: the writer of another certificate can compute another hash.
    """
    with errors_as_exit_codes():
        from tuning.certificate.certificate_files import is_unchanged

        unchanged = is_unchanged(file)
        if json:
            print_json({"file": str(file), "unchanged": unchanged})
        if not unchanged:
            fail(f"{file} was changed since it was written: its hash does not match its content", REFUSED)
    if not json:
        print(f"{file} is unchanged")
