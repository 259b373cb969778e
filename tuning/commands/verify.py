"""`drive-tune verify`: whether a certificate is as it was written."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tuning.commands.options import REFUSED, errors_as_exit_codes, fail


def verify(
    file: Annotated[Path, typer.Argument(help="certificate.json or report.html of a tuning.")],
) -> None:
    """Tell whether a certificate or its report was changed since it was written; exit code 1 if it was.

    The hash shows a change, it is no signature: whoever writes another certificate can write another hash.
    """
    with errors_as_exit_codes():
        from tuning.certificate.certificate_files import is_unchanged

        if not is_unchanged(file):
            fail(f"{file} was changed since it was written: its hash is not that of its content", REFUSED)
    print(f"{file} is as it was written")
