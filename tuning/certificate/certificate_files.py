"""A certificate's files: written together with its report, read without loss of digits, and checked by their hashes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np

from drive_env.whole_file import content_hash, files_to_be
from mechanics.arrays import Floats
from mechanics.reading.untrusted import parse_json, read_text
from tuning.certificate.certificate import FORMAT, HASH, STEPPER_FORMAT, Certificate, CertificateError
from tuning.certificate.report import html_is_unchanged, to_html
from tuning.runs.inputs import Input, write_inputs


@contextmanager
def certificate_files(
    certificate: Certificate, folder: str | Path, inputs: Iterable[Input] = ()
) -> Iterator[tuple[Path, Path]]:
    """Write certificate.json, report.html and inputs/ before a block runs; the first two are removed if it fails.

    Raises:
        OSError: If they cannot be written, with the file and the reason.
    """
    write_inputs(Path(folder), inputs)
    told, report = Path(folder) / "certificate.json", Path(folder) / "report.html"
    with files_to_be({told: certificate.to_json(), report: to_html(certificate)}):
        yield told, report


def load_certificate(path: str | Path) -> tuple[Certificate, bool]:
    """Read a certificate from a JSON file; return it and whether its hash is correct.

    Raises:
        CertificateError: If the file is not a certificate.
    """
    data = _read(Path(path), FORMAT)
    stated = data.pop(HASH)
    unchanged = content_hash(data) == stated
    data.pop("format")
    try:
        return _built(Certificate, data), unchanged
    except (KeyError, TypeError, ValueError) as error:
        raise CertificateError(f"{path} is not a certificate of this version: {error}") from None


def is_unchanged(path: str | Path) -> bool:
    """Return whether a certificate.json, a stepper-certificate.json or a report.html is unchanged since it was written.

    Raises:
        CertificateError: If it is another kind of file.
    """
    where = Path(path)
    if where.suffix == ".html":
        return html_is_unchanged(_text(where))
    data = _read(where, FORMAT, STEPPER_FORMAT)
    return bool(content_hash({k: v for k, v in data.items() if k != HASH}) == data[HASH])


def _read(path: Path, *formats: int | str) -> dict[str, Any]:
    try:
        data = parse_json(_text(path))
    except CertificateError:
        raise
    except ValueError as error:
        raise CertificateError(f"{path} is not a certificate: {error}; give a certificate.json of drive-tune") from None
    if not isinstance(data, dict) or HASH not in data or data.get("format") not in formats:
        raise CertificateError(f"{path} is not a certificate of format {FORMAT}; give a certificate.json of drive-tune")
    return data


def _text(path: Path) -> str:
    try:
        return read_text(path)
    except OSError as error:
        raise CertificateError(f"cannot read {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise CertificateError(f"{path} is not a text file; give a certificate.json of drive-tune") from None


def _built(kind: Any, data: Mapping[str, Any]) -> Any:
    """Build a dataclass from the plain data of `_plain`."""
    kinds = get_type_hints(kind)
    return kind(**{f.name: _value(kinds[f.name], data[f.name]) for f in fields(kind)})


def _value(kind: Any, value: Any) -> Any:
    if get_origin(kind) is tuple:
        item = get_args(kind)[0]
        return tuple(_built(item, one) for one in value) if is_dataclass(item) else tuple(value)
    if get_origin(kind) is Mapping and is_dataclass(item := get_args(kind)[1]):
        return {name: _built(item, one) for name, one in value.items()}
    if kind == Mapping[str, float]:
        return {name: _number(one) for name, one in value.items()}
    if kind == Floats:
        return np.array([_number(one) for one in value], float)
    return _number(value) if kind is float else value


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)
