"""The file of a trained agent: one small .npz with everything needed to act, and its origin.

It contains arrays without pickles and, as `about`, JSON: kind, settings, environment with its configuration, card,
versions and a hash of all that. The observation's normaliser is one of the arrays, never a second file.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mechanics.reading.untrusted import TooLargeError, parse_json, read_arrays
from tuning.runs.inputs import as_kept, found_again

FORMAT, FORMAT_VERSION = "drive-agent", 1
MAX_BYTES = 1_000_000  # of a file, which ships in the package and is read by a small computer
MOST_UNPACKED = 20_000_000  # bytes; weights hardly compress, so that an agent of MAX_BYTES has some 2 MB
# Keys of the JSON besides format and hash.
KINDS_OF_ABOUT = {"kind": str, "settings": dict, "environment": str, "configuration": dict, "card": dict,
                  "versions": dict}  # fmt: skip
ABOUT = "about"  # the array with the JSON, as bytes
AN_AGENT = "the .npz that drive-agent train writes, or the name of an agent that ships"


class BundleError(ValueError):
    """A file is not a valid bundle, or would not be one; the message gives the mistake and the remedy."""


@dataclass(frozen=True)
class AgentFile:
    """A trained agent as data.

    Attributes:
        kind: Type of the policy: a row of `policy.KINDS`.
        arrays: Numbers by name, e.g. weights and normaliser.
        settings: Further data of the kind, in the form of JSON.
        environment: Name of the environment that it was trained in, e.g. "ServoDrive/Tracking-v0".
        configuration: The environment's options that observations and actions depend on, in the form of JSON.
        card: How it was trained, on what distribution, with which seeds, its scores, and its limits.
        versions: Package -> version at its creation.
    """

    kind: str
    arrays: Mapping[str, NDArray[Any]]
    settings: Mapping[str, Any]
    environment: str
    configuration: Mapping[str, Any] = field(default_factory=dict)
    card: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, array in self.arrays.items():
            if name == ABOUT:
                raise BundleError(f"no array can be named {ABOUT!r}: that is the file's own; choose another name")
            if array.dtype.kind not in "fiub":
                raise BundleError(f"array {name!r} holds {array.dtype}; a bundle holds numbers")
            if array.dtype.kind == "f" and not np.all(np.isfinite(array)):
                raise BundleError(f"array {name!r} holds NaN or infinity: the training diverged; use a checkpoint")

    @property
    def hash(self) -> str:
        """SHA-256 of everything in it, hexadecimal."""
        digest = hashlib.sha256(_canonical(self._about()).encode())
        for name in sorted(self.arrays):
            array = np.ascontiguousarray(self.arrays[name])
            digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
            digest.update(array.tobytes())
        return digest.hexdigest()

    def save(self, path: str | Path) -> Path:
        """Write the bundle; equal bundles make equal files.

        Raises:
            BundleError: If it would be larger than MAX_BYTES, or its tables have values that JSON lacks.
        """
        from drive_env.whole_file import write_whole  # imported here: acting with an agent needs only NumPy

        path = Path(path)
        about = _canonical({**self._about(), "hash": self.hash}).encode()
        arrays = {name: np.ascontiguousarray(self.arrays[name]) for name in sorted(self.arrays)}
        memory = io.BytesIO()
        np.savez_compressed(memory, allow_pickle=False, **{ABOUT: np.frombuffer(about, np.uint8), **arrays})
        content = memory.getvalue()
        if len(content) > MAX_BYTES:
            raise BundleError(
                f"{path} would have {len(content)} bytes and {MAX_BYTES} are allowed; use a smaller network"
            )
        write_whole(path, content)
        return path

    @classmethod
    def load(cls, path: str | Path) -> AgentFile:
        """Read a bundle.

        Raises:
            BundleError: If the file is missing, of another format, or was changed after it was written.
            InputError: If a file of its training beside it was changed.
        """
        path = Path(path)
        try:
            arrays = read_arrays(path, MOST_UNPACKED)
            about = parse_json(bytes(arrays.pop(ABOUT)))
        except FileNotFoundError:
            raise BundleError(f"there is no file {path}") from None
        except (IsADirectoryError, PermissionError) as error:
            raise BundleError(f"cannot read {path}: {error.strerror}; give {AN_AGENT}") from None
        except TooLargeError as error:
            raise BundleError(f"{error} Give {AN_AGENT}") from None
        except (OSError, KeyError, ValueError):
            raise BundleError(f"{path} is not an agent; give {AN_AGENT}") from None
        if not isinstance(about, dict) or about.get("format") != FORMAT:
            raise BundleError(f"{path} is not an agent; give {AN_AGENT}")
        if about.get("format_version") != FORMAT_VERSION:
            raise BundleError(
                f"{path} has format {about.get('format_version')} and this drive-env reads {FORMAT_VERSION}; "
                "use the drive-env that wrote it, or train again"
            )
        if not all(isinstance(about.get(name), kind) for name, kind in KINDS_OF_ABOUT.items()):
            raise BundleError(f"{path} is not an agent; give {AN_AGENT}")
        bundle = cls(arrays=arrays, **{name: about[name] for name in KINDS_OF_ABOUT})
        if bundle.hash != about.get("hash"):
            raise BundleError(f"{path} was changed after it was written: its hash is {bundle.hash[:12]}…; get it again")
        # For a load by path the copy beside the bundle, never a file of that name in the present folder.
        kept = found_again(bundle.configuration, bundle.card.get("inputs"), path.parent, alone=True)
        return replace(bundle, configuration=kept)

    def _about(self) -> dict[str, Any]:
        return {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "kind": self.kind,
            "settings": dict(self.settings),
            "environment": self.environment,
            "configuration": as_kept(self.configuration),
            "card": dict(self.card),
            "versions": dict(self.versions),
        }


def installed(*packages: str) -> dict[str, str]:
    """Return the versions of packages; those that are not installed are left out."""
    found = {}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def _canonical(table: Mapping[str, Any]) -> str:
    try:
        return json.dumps(table, sort_keys=True, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    except (TypeError, ValueError) as error:
        raise BundleError(f"card, settings and configuration hold what JSON holds: {error}; use bundle.plain") from None
