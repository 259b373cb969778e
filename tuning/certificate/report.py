"""The report of a tuning: a certificate as one HTML file that contains its pictures."""

from __future__ import annotations

import base64
import hashlib
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure

from drive_env.devices import find_device
from tuning.certificate.certificate import CROSSOVERS, CertificateError
from tuning.certificate.certificate_pictures import bode_picture, step_picture
from tuning.estimate import interval
from tuning.identify.identified_axis import TITLES

if TYPE_CHECKING:
    from drive_env.devices.gain_set import GainSet
    from tuning.certificate.certificate import AxisCertificate, Certificate, Correction

RATIO = CROSSOVERS[-1]
# Usual advice, not a limit: three quarters of the best gains of single axes that keep all constraints exceed it.
USUAL_RATIO = 0.5
SEAL = "<!-- sha256 of all before this line: "

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #1a1a1a; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.2rem; margin-top: 2.2rem; border-bottom: 1px solid #ccc; }
h3 { font-size: 1rem; margin-bottom: .3rem; }
table { border-collapse: collapse; margin: .4rem 0 1rem; } th, td { padding: .15rem .8rem .15rem 0; text-align: left; }
th { font-weight: 600; border-bottom: 1px solid #999; } td.number, th.number { text-align: right; }
td { border-bottom: 1px solid #e6e6e6; font-variant-numeric: tabular-nums; }
img { max-width: 100%; height: auto; } .refused { color: #777; } code { font-size: .85em; overflow-wrap: anywhere; }
.accepted { color: #00693e; font-weight: 600; } .rejected { color: #a4001d; font-weight: 600; }
.reserved { color: #8a5a00; font-weight: 600; } ul.reserved { font-weight: 400; }
"""

# For each verdict: its CSS class, and its meaning.
COLOURS = {
    "accepted": ("accepted", "new gains in the drive"),
    "accepted with reservations": ("reserved", "new gains in the drive, with reservations"),
    "rejected": ("rejected", "rejected; the drive has its gains from before"),
}


def to_html(certificate: Certificate) -> str:
    """Return the report as HTML; its last line is a hash over everything before it."""
    title = f"Tuning of {certificate.device} with {certificate.motor}"
    body = [f"<h1>{escape(title)}</h1>", _summary(certificate)]
    for axis in certificate.axes:
        body += _axis(axis, find_device(certificate.device).gains)
    body += ["<h2>Conditions and versions</h2>", _pairs(certificate.versions)]
    text = (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        + "\n".join(body)
        + "\n</body>\n</html>\n"
    )
    return f"{text}{SEAL}{_hash(text)} -->\n"


def html_is_unchanged(text: str) -> bool:
    """Return whether a report is unchanged since it was written.

    Raises:
        CertificateError: If the text is not a report.
    """
    content, seal, stated = text.rpartition(SEAL)
    if not seal:
        raise CertificateError("the file is not a report of drive-tune: it does not end with its hash")
    return stated == f"{_hash(content)} -->\n"


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


# --- the parts --------------------------------------------------------------------------------------------------------
def _summary(certificate: Certificate) -> str:
    axes = certificate.axes
    rows = {
        "machine": certificate.machine,
        "tuner": certificate.tuner,
        "supply as entered [V]": _figure(certificate.supply),
        "seed": str(certificate.seed),
        "made": certificate.created,
        "drive time [s]": _figure(max((axis.hardware_seconds for axis in axes), default=0.0)),
        "trials stopped for oscillation or fault": str(sum(axis.aborts for axis in axes)),
        "axes with new gains": f"{sum(axis.accepted for axis in axes)} of {len(axes)}",
        "of these, accepted with reservations": str(sum(axis.accepted and bool(axis.reservations) for axis in axes)),
    } | {
        f"limit: {name}": _figure(value) if math.isfinite(value) else "none"
        for name, value in certificate.envelope.items()
    }
    return _pairs(rows) + f"<p>Hash of the certificate's content (SHA-256): <code>{certificate.hash()}</code></p>"


def _axis(axis: AxisCertificate, known: GainSet) -> list[str]:
    colour, words = COLOURS[axis.verdict]
    parts = [
        f"<h2>Axis {axis.axis}: <span class='{colour}'>{words}</span></h2>",
        f"<p>{escape(axis.reason)}</p>",
        *([_list("reserved", axis.reservations)] if axis.reservations else []),
        "<h3>Gains</h3>",
        _gains(axis, known),
    ]
    if axis.requirements:
        parts += [f"<h3>Dynamics asked for: {escape(axis.dynamics)}</h3>", _requirements(axis)]
    if axis.figures:
        parts += ["<h3>Bandwidths</h3>", _crossovers(axis.figures)]
    if axis.corrections:
        parts += ["<h3>Corrections by what the drive showed</h3>", _corrections(axis.corrections, known)]
    if axis.notes:
        parts.append(_list("notes", axis.notes))
    if axis.identified:
        parts += ["<h3>Identified parameters, with 95 % confidence intervals</h3>", _identified(axis)]
    for name in dict.fromkeys(step.name for step in axis.steps):
        steps = [step for step in axis.steps if step.name == name]
        parts += [f"<h3>{escape(name)}</h3>", _image(step_picture(steps), f"{name} over time")]
        parts.append(_before_and_after([(step.tuned, step.figures) for step in steps]))
    for name in dict.fromkeys(found.name for found in axis.frequency_responses):
        responses = [found for found in axis.frequency_responses if found.name == name]
        sources = "; ".join(dict.fromkeys(found.source for found in responses if found.source))
        parts += [f"<h3>Open {escape(name)}</h3>", _image(bode_picture(responses), f"Bode diagram of the open {name}")]
        if sources:
            parts.append(f"<p>Source: {escape(sources)}.</p>")
        parts.append(_before_and_after([(found.tuned, found.margins) for found in responses], absent="not measured"))
    return parts


def _list(kind: str, lines: Iterable[str]) -> str:
    return f'<ul class="{kind}">' + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"


def _gains(axis: AxisCertificate, known: GainSet) -> str:
    rows = []
    si = list(zip(axis.before_si.items(), axis.after_si.values(), strict=True))
    for k, (name, (index, sub)) in enumerate(zip(known.titles, known.keys, strict=True)):
        (meaning, before), after = si[k] if k < len(si) else (("", math.nan), math.nan)
        label = f"{index:04X}h:{sub:02X}"
        cells = [name, label, axis.before[k], axis.after[k], meaning, _figure(before), _figure(after)]
        rows.append([str(cell) for cell in cells])
    return _table(("gain", "object", "before", "after", "in SI units", "before", "after"), rows, numbers=(2, 3, 5, 6))


def _requirements(axis: AxisCertificate) -> str:
    rows = []
    for one in axis.requirements:
        bound = "at least " if one.is_bound else ""
        rows.append([one.name, _figure(one.asked), f"{bound}{_figure(one.found)}", one.kept])
    return _table(("", "asked for", "found", ""), rows, numbers=(1, 2))


def _crossovers(figures: Mapping[str, float]) -> str:
    text = _pairs({name: _figure(value) if math.isfinite(value) else "not measured" for name, value in figures.items()})
    if figures[RATIO] <= USUAL_RATIO or math.isnan(figures[RATIO]):
        return text
    return text + (
        f"<p class='reserved'>The position loop crosses over beyond {USUAL_RATIO:g} of the velocity loop's crossover; "
        "usual advice is to stay below. What counts are the margins of both loops.</p>"
    )


def _corrections(corrections: Sequence[Correction], known: GainSet) -> str:
    rows = []
    for number, one in enumerate(corrections, start=1):
        changed = [
            f"{title} {old} → {new}"
            for title, old, new in zip(known.titles, one.old, one.new, strict=True)
            if old != new
        ]
        rows.append([str(number), ", ".join(changed), one.reason, one.outcome])
    return _table(("", "gains", "because", "outcome"), rows)


def _identified(axis: AxisCertificate) -> str:
    rows = []
    for name, found in axis.identified.items():
        words = TITLES.get(name, name)
        if math.isnan(found.value):
            rows.append([words, "not identified", "", found.unit, found.reason])
        else:
            unit = "" if found.unit == "1" else found.unit
            rows.append([words, _figure(found.value), interval(found.low, found.high), unit, found.reason])
    return _table(("parameter", "value", "interval", "unit", ""), rows, numbers=(1,))


def _before_and_after(found: Sequence[tuple[bool, Mapping[str, float]]], absent: str = "–") -> str:  # noqa: RUF001
    """Return a table of figures with one column for each set of gains; `absent` is shown for a missing figure."""
    names = list(dict.fromkeys(name for _, figures in found for name in figures))
    if not names:
        return ""
    heads = [("new gains" if tuned else "gains before") for tuned, _ in found]
    every = [[figures.get(name, math.nan) for _, figures in found] for name in names]
    cells = [[_figure(value) if math.isfinite(value) else absent for value in row] for row in every]
    rows = [[name, *row] for name, row in zip(names, cells, strict=True)]
    return _table(("", *heads), rows, numbers=range(1, len(heads) + 1))


def _pairs(rows: Mapping[str, str]) -> str:
    return _table((), [[name, value] for name, value in rows.items()])


def _table(heads: Iterable[str], rows: Iterable[Sequence[str]], numbers: Iterable[int] = ()) -> str:
    right = set(numbers)

    def cells(tag: str, row: Iterable[str]) -> str:
        kinds = (' class="number"' if k in right else "" for k, _ in enumerate(list(heads) or [""] * 9))
        return "".join(f"<{tag}{kind}>{escape(cell)}</{tag}>" for cell, kind in zip(row, kinds, strict=False))

    head = f"<thead><tr>{cells('th', heads)}</tr></thead>" if list(heads) else ""
    return f"<table>{head}<tbody>" + "".join(f"<tr>{cells('td', row)}</tr>" for row in rows) + "</tbody></table>"


def _figure(value: Any) -> str:
    """Format a number with four digits; nan becomes a dash."""
    number = float(value)
    return "–" if math.isnan(number) else f"{number:.4g}"  # noqa: RUF001  # an en dash


def _image(figure: Figure, text: str) -> str:
    data = io.BytesIO()
    figure.savefig(data, format="png")
    coded = base64.b64encode(data.getvalue()).decode()
    return f'<img alt="{escape(text, quote=True)}" src="data:image/png;base64,{coded}">'
