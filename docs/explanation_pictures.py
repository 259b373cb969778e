"""The pictures of docs/explanation/ and docs/safety.md: `python docs/explanation_pictures.py` makes them anew.

Diagrams are SVG, drawn from the rows below; plots are PNG, of runs that are made here, with seeds. Names of pictures
given on the command line make these alone.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import escape

import numpy as np

FOLDER = Path(__file__).parent / "assets" / "explanation"
INK, GREY, BLUE, ORANGE, GREEN, RED, AMBER = (
    "#1a1a1a", "#6b6b6b", "#1f5fa8", "#c2570c", "#2e7d32", "#b3261e", "#b7791f",
)  # fmt: skip
PALE = {BLUE: "#e3edf8", ORANGE: "#fbe9dc", GREEN: "#e4f2e5", RED: "#f9e1df", AMBER: "#f9f0d9", GREY: "#efefef"}
WIDTH = 360  # of every diagram: the width of a telephone


# --- diagrams ---------------------------------------------------------------------------------------------------------
class Drawing:
    """An SVG of `WIDTH` with a white ground, so that it reads in a dark theme, too."""

    def __init__(self, title: str, height: float) -> None:
        self.title, self.height = title, height
        self.parts: list[str] = []

    def box(self, x: float, y: float, w: float, h: float, lines: str, colour: str = BLUE) -> None:
        """Draw a block with its lines of text, the first in bold."""
        self.parts.append(
            f'<rect x="{x}" y="{y}" width="{w}" height="{h}" rx="5" fill="{PALE[colour]}" stroke="{colour}"/>'
        )
        rows = lines.split("\n")
        top = y + h / 2 - 8 * (len(rows) - 1) + 4.5
        for number, row in enumerate(rows):
            self.text(x + w / 2, top + 16 * number, row, bold=number == 0, small=number > 0)

    def text(
        self, x: float, y: float, text: str, *, bold: bool = False, small: bool = False, anchor: str = "middle",
        colour: str = INK, upwards: bool = False,
    ) -> None:  # fmt: skip
        """Write a line, from below upwards if so asked."""
        turn = f' transform="rotate(-90 {x} {y})"' if upwards else ""
        weight = ' font-weight="bold"' if bold else ""
        self.parts.append(
            f'<text{turn} x="{x}" y="{y}" text-anchor="{anchor}" font-size="{12 if small else 13.5}" fill="{colour}"'
            f"{weight}>{escape(text)}</text>"
        )

    def arrow(self, *points: tuple[float, float], colour: str = INK) -> None:
        """Draw a way with a head at its end."""
        way = " ".join(f"{x},{y}" for x, y in points)
        self.parts.append(f'<polyline points="{way}" fill="none" stroke="{colour}" stroke-width="1.6"/>')
        (x0, y0), (x, y) = points[-2:]
        length = float(np.hypot(x - x0, y - y0))
        u, v = (x - x0) / length, (y - y0) / length
        head = [(x, y), (x - 8 * u - 4 * v, y - 8 * v + 4 * u), (x - 8 * u + 4 * v, y - 8 * v - 4 * u)]
        corners = " ".join(f"{a:.1f},{b:.1f}" for a, b in head)
        self.parts.append(f'<polygon points="{corners}" fill="{colour}"/>')

    def svg(self) -> str:
        """Return the file's text."""
        return "\n".join((
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {self.height}" width="480" role="img" '
            'font-family="Helvetica, Arial, sans-serif">',
            f"<title>{escape(self.title)}</title>",
            f'<rect width="{WIDTH}" height="{self.height}" fill="#ffffff"/>',
            *self.parts,
            "</svg>\n",
        ))  # fmt: skip


def column(drawing: Drawing, rows: list[tuple[str, str, str]], x: float, w: float, y: float, h: float, gap: float,
           beside: float) -> float:  # fmt: skip
    """Draw blocks one below the other, with the data from one to the next beside the arrow; return the lower end."""
    for number, (lines, below, colour) in enumerate(rows):
        drawing.box(x, y, w, h, lines, colour)
        if number < len(rows) - 1:
            drawing.arrow((x + w / 2, y + h), (x + w / 2, y + h + gap))
            drawing.text(beside, y + h + gap / 2 + 4, below, small=True, anchor="start", colour=GREY)
            y += h + gap
    return y + h


def emulator_path() -> str:
    """Return the way of a command from the bus to the load and back."""
    rows = [
        ("CAN node\nSDO, PDO, SYNC, NMT, EMCY", "integers of the drive", GREY),
        ("Object dictionary\naccess, limits, units", "SI values", GREY),
        ("State machine, mode, profile\n1 kHz", "position demand", BLUE),
        ("Position and velocity loop\n5 kHz", "current demand", BLUE),
        ("Current loop\n25 kHz", "voltage", BLUE),
        ("Power stage and winding\n25 kHz, exact matrices", "torque", ORANGE),
        ("Load in MuJoCo\none step per 200 µs", "angle, speed", GREEN),
        ("Sensors\nencoder, halls, phase currents", "", ORANGE),
    ]
    drawing = Drawing("From the bus to torque and back", 572)
    column(drawing, rows, 64, 232, 10, 48, 24, 188)
    drawing.arrow((296, 538), (336, 538), (336, 250), (296, 250), colour=ORANGE)
    drawing.arrow((336, 322), (296, 322), colour=ORANGE)
    drawing.arrow((64, 538), (24, 538), (24, 106), (64, 106), colour=ORANGE)
    drawing.text(16, 330, "actual values", small=True, colour=GREY, upwards=True)
    drawing.text(352, 420, "feedback", small=True, colour=GREY, upwards=True)
    return drawing.svg()


def emulator_cascade() -> str:
    """Return the three loops, one inside the other."""
    drawing = Drawing("The cascade: position, velocity and current loop", 470)
    rows = [
        ("Position controller\nP", "velocity demand", BLUE),
        ("Velocity controller\nPI, 5 kHz, limit of current", "current demand", BLUE),
        ("Current controller\nPI, 25 kHz, limit of voltage", "voltage", BLUE),
        ("Winding and motor\ntorque = Kt x current", "torque", ORANGE),
        ("Load", "", GREEN),
    ]
    drawing.text(150, 20, "position demand (profile) + velocity offset", small=True, colour=GREY)
    drawing.arrow((140, 26), (140, 44))
    column(drawing, rows, 40, 200, 44, 46, 34, 148)
    drawing.arrow((240, 387), (340, 387), (340, 67), (240, 67), colour=GREEN)
    drawing.text(354, 227, "position", small=True, colour=GREEN, upwards=True)
    drawing.arrow((240, 377), (306, 377), (306, 147), (240, 147), colour=BLUE)
    drawing.text(322, 262, "speed, filtered", small=True, colour=BLUE, upwards=True)
    drawing.arrow((240, 307), (272, 307), (272, 227), (240, 227), colour=ORANGE)
    drawing.text(288, 267, "current", small=True, colour=ORANGE, upwards=True)
    drawing.text(180, 440, "Each loop must be several times faster", small=True, colour=GREY)
    drawing.text(180, 456, "than the one around it.", small=True, colour=GREY)
    return drawing.svg()


def emulator_millisecond() -> str:
    """Draw one millisecond of the emulator."""
    drawing = Drawing("One millisecond of the TMCM-1636", 236)
    drawing.box(10, 12, 340, 40, "supervision, once\nstate machine, protection, mode, profile", GREY)
    for window in range(5):
        x = 10 + 68 * window
        drawing.box(x, 66, 64, 40, "motion\nloops", BLUE)
        for tick in range(5):
            drawing.parts.append(
                f'<rect x="{x + 13 * tick}" y="116" width="11" height="26" rx="2" fill="{PALE[ORANGE]}" '
                f'stroke="{ORANGE}"/>'
            )
        drawing.box(x, 152, 64, 34, "load", GREEN)
        drawing.text(x + 32, 202, f"{(window + 1) * 200} µs", small=True, colour=GREY)
    drawing.text(180, 226, "orange: 25 current ticks of 40 µs", small=True, colour=ORANGE)
    return drawing.svg()


def certificate_steps() -> str:
    """Return the way to a verdict."""
    rows = [
        ("Look and back up\nwiring, current parameters → before.toml", "", GREY),
        ("Identify\ntwo short moves, with 95 % intervals", "", BLUE),
        ("Design gains on digital twins\nmargins first, then performance", "", BLUE),
        ("Try them on the drive\nmove, reversal, 1.5 x velocity P", "", BLUE),
        ("Verify at rest and in csp\nswing, overshoot of a small step", "", BLUE),
        ("Measure the loops\nphase and gain margin, Ms", "", BLUE),
    ]
    drawing = Drawing("How a certificate comes about", 560)
    end = column(drawing, rows, 10, 264, 10, 46, 18, 0)
    drawing.arrow((274, end - 23), (318, end - 23), (318, 161), (274, 161), colour=AMBER)
    drawing.text(333, 262, "falls short of the dynamics:", small=True, colour=AMBER, upwards=True)
    drawing.text(348, 262, "design again, at most twice", small=True, colour=AMBER, upwards=True)
    for x, lines, colour in (
        (6, "green\naccepted", GREEN),
        (124, "amber\nwith reservations", AMBER),
        (242, "red\nrejected", RED),
    ):
        drawing.box(x, end + 42, 112, 44, lines, colour)
        drawing.arrow((142, end), (142, end + 18), (x + 56, end + 18), (x + 56, end + 42), colour=colour)
    drawing.text(62, end + 106, "new gains stay", small=True, colour=GREY)
    drawing.text(180, end + 106, "new gains stay", small=True, colour=GREY)
    drawing.text(298, end + 106, "old gains are back", small=True, colour=GREY)
    drawing.height = end + 122
    return drawing.svg()


def score_parts() -> str:
    """Draw the parts of J and of the robust cost."""
    drawing = Drawing("What J, the constraints and the robust cost are made of", 452)
    parts = (
        ("settling time", "after the move", BLUE),
        ("disturbance", "after a load step", ORANGE),
        ("current noise", "at rest", GREEN),
        ("overshoot", "of the move", RED),
    )
    for number, (name, when, colour) in enumerate(parts):
        x, y = 10 + 175 * (number % 2), 10 + 62 * (number // 2)
        drawing.box(x, y, 165, 46, f"{name}\n{when}", colour)
    drawing.arrow((92, 122), (92, 150))
    drawing.arrow((268, 122), (268, 136), (92, 136), (92, 150))
    drawing.box(10, 150, 165, 46, "J of one machine\nproduct, at most 30", GREY)
    drawing.box(185, 150, 165, 46, "constraints\nby the dynamics", AMBER)
    drawing.arrow((92, 196), (92, 232))
    drawing.text(100, 218, "5 variants", small=True, anchor="start", colour=GREY)
    drawing.arrow((268, 196), (268, 232))
    drawing.text(276, 218, "5 variants", small=True, anchor="start", colour=GREY)
    drawing.box(10, 232, 165, 46, "performance\n½ J + ½ worst J", GREY)
    drawing.box(185, 232, 165, 46, "slack\nof the tightest one", AMBER)
    drawing.arrow((92, 278), (92, 312))
    drawing.arrow((268, 278), (268, 312))
    drawing.box(10, 312, 340, 46, "robust cost\nkept: below 30, by performance; broken: 30 to 60", GREEN)
    rows = (
        "Constraints: phase margin, gain margin, Ms,",
        "overshoot of a step in csp, swing at rest.",
        "Variants: load inertia x 0.5 and x 2,",
        "stiffness x 0.8, velocity P x 0.67 and x 1.5",
    )
    for number, row in enumerate(rows):
        drawing.text(180, 384 + 18 * number, row, small=True, colour=GREY)
    return drawing.svg()


# --- runs and their plots ---------------------------------------------------------------------------------------------
class Example(NamedTuple):
    """Gains of the worked example in docs/explanation/score.md, as the drive's integers."""

    name: str
    gains: tuple[int, int, int, int, int]


EXAMPLES = (
    Example("lively", (4021, 1573, 908, 1499, 592)),
    Example("faster: velocity P x 1.4, position P x 2", (4021, 1573, 1271, 1499, 1184)),
    Example("as auto designs", (5580, 1579, 1108, 1861, 385)),  # `drive-tune auto --load belt`
)
BELT_INERTIA = 2.34e-5  # kg*m^2 at the rotor, as `drive-tune identify --load belt` finds it


def _score():  # type: ignore[no-untyped-def]
    """Return the scorer of a belt axis, ready to score."""
    from drive_env import EmulatedDrives
    from drive_env.motors import MOTORS
    from drive_env.trials.positioning import plan_move, reach
    from drive_env.trials.score import RobustScore

    motor = MOTORS["qbl4208"]
    scorer = RobustScore("tmcm1636", "belt", "qbl4208", 1, num_threads=1)
    with EmulatedDrives(load="belt", num_machines=1, num_threads=1) as drives:
        scorer.set_machines(drives.machine.parameters, drives.machine.supply)
    scorer.set_moves(plan_move(motor, np.full(1, BELT_INERTIA), 65536, reach("belt")))
    return scorer


def worked_example() -> list[tuple[str, list[int], dict[str, float]]]:
    """Return of each example its name, its integers and figures: terms, J and clearance of variants, robust cost."""
    scorer = _score()
    found = []
    for name, own in EXAMPLES:
        gains = np.array([own], np.int64)
        scores = scorer.score(gains)
        terms = scores.terms
        figures = {
            "settling": float(terms.settling[0, 0]),
            "disturbance": float(terms.disturbance[0, 0]),
            "noise": float(terms.noise[0, 0]),
            "overshoot": float(terms.overshoot[0, 0]),
            **{variant.name: float(j) for variant, j in zip(scorer.variants, scores.j[0], strict=True)},
            **{
                f"clearance, {variant.name}": float(one)
                for variant, one in zip(scorer.variants, scores.clearance[0], strict=True)
            },
            "least clearance": float(scores.clearance[0, 1:].min()),
            "csp overshoot": float(scores.overshoot[0]),
            "swing at rest": float(scores.rest[0, 0]),
            "performance": float(scores.performance[0]),
            "slack": float(scores.slack[0]),
            "robust": float(scores.robust_cost[0]),
        }
        found.append((name, [int(gain) for gain in gains[0]], figures))
    scorer.close()
    return found


def _axes(height: float, rows: int = 1, *, same_x: bool = True):  # type: ignore[no-untyped-def]
    """Return figure and axes of a picture that reads at 360 px, on white; rows have the same x-axis by default."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    plt.rcParams.update({
        "font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "grid.alpha": 0.3,
        "legend.frameon": False, "lines.linewidth": 1.4, "svg.hashsalt": "drive-env",
    })  # fmt: skip
    return plt.subplots(rows, 1, figsize=(4.2, height), layout="constrained", sharex=rows > 1 and same_x, squeeze=False)


def _save(figure, path: Path) -> None:  # type: ignore[no-untyped-def]
    figure.savefig(path, dpi=200, facecolor="white", metadata={"Software": None})


def emulator_friction(path: Path) -> None:
    """Plot a slow reversal of a belt axis with each model of friction."""
    from drive_env import EmulatedDrives, motion

    figure, ((above,), (below,)) = _axes(4.2, 2)
    for model, colour in (("none", GREY), ("coulomb_viscous", BLUE), ("stribeck", ORANGE), ("lugre", GREEN)):
        with EmulatedDrives("tmcm1636", load="belt", num_threads=1, friction=model, ideal=True) as drives:
            motion.enable(drives, mode="pv")
            drives.write("Profile acceleration", "4 rev/s^2")
            drives.write("Target velocity", "40 rpm")
            drives.advance(0.5)
            drives.write("Target velocity", "-40 rpm")
            trace = drives.record(["Velocity actual value", "Torque actual value"], duration=0.6)
            above.plot(trace.t, trace["Velocity actual value", "rpm"][:, 0], color=colour, label=model)
            below.plot(trace.t, _smooth(trace["Torque actual value"][:, 0] * 1e-3), color=colour)
    above.set_ylabel("speed [rpm]")
    below.set(xlabel="time [s]", ylabel="current [A]")
    above.legend(fontsize=8)
    _save(figure, path)


def _smooth(values, width: int = 8):  # type: ignore[no-untyped-def]
    return np.convolve(np.pad(values, (width // 2, width - width // 2 - 1), "edge"), np.ones(width) / width, "valid")


def emulator_imperfections(path: Path) -> None:
    """Plot the current of an axis that turns slowly, with and without the imperfections of a real stage."""
    from drive_env import EmulatedDrives, motion

    figure, ((axes,),) = _axes(2.6)
    for ideal, colour, name in ((False, ORANGE, "class values (default)"), (True, BLUE, "ideal=True")):
        with EmulatedDrives("tmcm1636", load="inertia", num_threads=1, ideal=ideal) as drives:
            motion.enable(drives, mode="pv")
            drives.write("Profile acceleration", "10 rev/s^2")
            drives.write("Target velocity", "60 rpm")
            drives.advance(0.5)
            trace = drives.record(["Torque actual value"], duration=0.5)
            axes.plot(trace.t, trace["Torque actual value"][:, 0] * 1e-3, color=colour, label=name, linewidth=0.9)
    axes.set(xlabel="time [s]", ylabel="actual current [A]")
    axes.legend(fontsize=8, loc="upper right")
    _save(figure, path)


def score_move(path: Path) -> None:
    """Plot the trial that J is made of, with lively gains: move, rest, load step."""
    from drive_env import EmulatedDrives, cia402
    from drive_env.drives.raw_gains import write_gains
    from drive_env.trials.positioning import plan_move, power_up, reach, start, write_profile

    _score().close()
    with EmulatedDrives("tmcm1636", load="belt", num_threads=1) as drives:
        move = plan_move(drives.motor, np.full(1, BELT_INERTIA), 65536, reach("belt"))
        write_gains(drives, np.array(EXAMPLES[0].gains)[None])
        write_profile(drives, move)
        power_up(drives)
        start(drives, move.distance)
        objects = [cia402.POSITION_ACTUAL, cia402.TORQUE_ACTUAL]
        free = drives.record(objects, 0.15)
        drives.machine.load_torque = -0.3 * drives.motor.rated_torque / _lever()
        loaded = drives.record(objects, 0.1)
    position = np.concatenate([free[cia402.POSITION_ACTUAL], loaded[cia402.POSITION_ACTUAL]])[:, 0]
    current = np.concatenate([free[cia402.TORQUE_ACTUAL], loaded[cia402.TORQUE_ACTUAL]])[:, 0] * 1e-3
    t = np.arange(len(position)) * 1.0  # ms
    error = (move.distance[0] - position) / move.distance[0] * 100.0
    figure, ((top,), (middle,), (below,)) = _axes(5.4, 3)
    top.plot(t, position / 65536.0, color=BLUE)
    top.set_ylabel("position [turns]")
    middle.plot(t, error, color=ORANGE)
    middle.set_ylim(-3, 8)
    middle.axhspan(-1, 1, color=GREEN, alpha=0.15)
    after, loads = t >= 60, t >= 150
    middle.fill_between(t[after & ~loads], error[after & ~loads], color=BLUE, alpha=0.3)
    middle.fill_between(t[loads], error[loads], color=ORANGE, alpha=0.3)
    middle.set_ylabel("distance to\ntarget [% of move]")
    below.plot(t, current, color=INK, linewidth=0.9)
    below.set(xlabel="time [ms]", ylabel="current [A]")
    for axes in (top, middle, below):
        axes.axvline(60, color=GREY, linestyle=":")
        axes.axvline(150, color=GREY, linestyle=":")
    top.text(62, 0.02, "profile ends", fontsize=8, color=GREY)
    top.text(152, 0.02, "load step", fontsize=8, color=GREY)
    middle.annotate("settling", (66, 3), (80, 5.5), fontsize=8, color=BLUE, arrowprops={"arrowstyle": "-"})
    middle.annotate("disturbance", (156, 0.7), (170, 5.5), fontsize=8, color=ORANGE, arrowprops={"arrowstyle": "-"})
    below.axvspan(105, 150, color=GREEN, alpha=0.15)
    below.text(107, below.get_ylim()[1] * 0.75, "noise", fontsize=8, color=GREEN)
    _save(figure, path)


def _lever() -> float:
    """Return how much of a disturbance at the belt's carriage reaches the rotor [m]."""
    from mechanics.loads import find_load
    from mechanics.shaft import one, way

    packed = one(find_load("belt"))
    return float(np.abs(way(packed).joints @ packed.plant.disturbance[:, 0]).max())


def score_variants(path: Path) -> None:
    """Plot J and the clearance of every variant for the gains of the worked example."""
    from drive_env.loops.dynamics import OFF_NOMINAL

    figure, ((above,), (below,)) = _axes(6.0, 2, same_x=False)
    rows = worked_example()
    names = [name for name in rows[0][2] if f"clearance, {name}" in rows[0][2]]
    labels = ["the machine" if name == "nominal" else name for name in names]
    place = np.arange(len(labels) + 1)
    for number, ((name, _, figures), colour) in enumerate(zip(rows, (GREY, RED, GREEN), strict=True)):
        values = [figures[variant] for variant in names]
        above.barh(place + 0.27 * (number - 1), [*values, figures["performance"]], 0.25, color=colour, label=name)
        clear = [figures[f"clearance, {variant}"] for variant in names]
        below.barh(place[:-1] + 0.27 * (number - 1), clear, 0.25, color=colour)
    above.set_yticks(place, [*labels, "performance"])
    below.set_yticks(place[:-1], labels)
    # What standard dynamics ask for: of the machine as it is, and of its variants.
    below.plot([1.0, 1.0], [-0.45, 0.45], color=INK, linewidth=2.0)
    below.plot([OFF_NOMINAL, OFF_NOMINAL], [0.55, len(names) - 0.55], color=INK, linewidth=2.0)
    for axes in (above, below):
        axes.invert_yaxis()
    above.set_xlabel("J (lower is better)")
    below.set_xlabel("clearance (black: asked for)")
    figure.legend(*above.get_legend_handles_labels(), fontsize=8, loc="outside upper center")
    _save(figure, path)


def certificate_bode(path: Path) -> None:
    """Plot the measured open velocity loop of a belt axis, as a certificate has it, and where its margins are."""
    import json
    import subprocess

    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "tuned"
        command = "from tuning.commands.cli import main; main()"
        arguments = ["auto", "--load", "belt", "--out", str(out)]
        subprocess.run([sys.executable, "-c", command, *arguments], check=True, stdout=subprocess.DEVNULL)
        axis = json.loads((out / "certificate.json").read_text(encoding="utf-8"))["axes"][0]
    found = next(r for r in axis["frequency_responses"] if r["tuned"] and r["name"] == "velocity loop")
    f, gain, phase, coherence = (
        np.array(found[key], float) for key in ("frequency", "magnitude_db", "phase_deg", "coherence")
    )
    margins = found["margins"]
    figure, ((top,), (middle,), (below,)) = _axes(5.4, 3)
    top.semilogx(f, gain, color=BLUE)
    top.axhline(0, color=INK, linewidth=0.8)
    top.set_ylabel("gain [dB]")
    middle.semilogx(f, phase, color=BLUE)
    middle.axhline(-180, color=INK, linewidth=0.8)
    middle.set_ylabel("phase [deg]")
    at, phase_margin = margins["phase margin at [Hz]"], margins["phase margin [deg]"]
    middle.plot([at, at], [-180, -180 + phase_margin], color=ORANGE, linewidth=2.5)
    middle.text(at * 1.08, -180 + phase_margin / 3, f"phase margin {phase_margin:.0f}°", fontsize=8, color=ORANGE)
    at, gain_margin = margins["gain margin at [Hz]"], margins["gain margin [dB]"]
    top.plot([at, at], [-gain_margin, 0], color=ORANGE, linewidth=2.5)
    top.text(at, 7, f"gain margin {gain_margin:.0f} dB", fontsize=8, color=ORANGE, ha="right")
    below.semilogx(f, coherence, color=GREEN)
    below.axhline(0.95, color=INK, linewidth=0.8, linestyle=":")
    below.set(xlabel="frequency [Hz]", ylabel="coherence", ylim=(0, 1.05))
    _save(figure, path)


def certificate_rest(path: Path) -> None:
    """Plot the current at rest of a belt axis, with gains that pass a move and with calmer ones."""
    from drive_env import EmulatedDrives, motion
    from drive_env.drives.raw_gains import write_gains

    figure, ((axes,),) = _axes(2.6)
    for factor, colour, name in ((3.0, RED, "velocity P x 3"), (1.0, GREEN, "lively")):
        with EmulatedDrives("tmcm1636", load="belt", num_threads=1) as drives:
            write_gains(
                drives, np.rint(np.array([EXAMPLES[0].gains]) * np.array([1, 1, factor, 1, 1])).astype(np.int64)
            )
            motion.enable(drives, mode="pp")
            drives.advance(0.3)
            drives.machine.load_torque = -0.3 * drives.motor.rated_torque / _lever()
            trace = drives.record(["Torque actual value"], duration=0.25)
            axes.plot(trace.t * 1e3, trace["Torque actual value"][:, 0] * 1e-3, color=colour, label=name, linewidth=0.9)
    axes.set(xlabel="time after a load step [ms]", ylabel="current [A]")
    axes.legend(fontsize=8)
    _save(figure, path)


def safety_stop(path: Path) -> None:
    """Plot two stops: a drive that follows its ramp, and one that does not and loses its voltage.

    Both are judged by the stop's own code (drive_env/safety/stopping.py), sample by sample.
    """
    from drive_env import EmulatedDrives, cia402, motion
    from drive_env.safety.bounds import REST_TURNS
    from drive_env.safety.stopping import AxisStop, Phase, Sample

    figure, ((speeds,), (currents,)) = _axes(4.6, 2)
    cases = (("obeys its ramp", 1.0, GREEN), ("velocity loop without gain", 0.0, RED))
    for name, share, colour in cases:
        with EmulatedDrives("tmcm1636", load="inertia", num_threads=1) as drives:
            motion.enable(drives, mode="pv")
            drives.write("Profile acceleration", "200 rev/s^2")
            drives.write("Quick stop deceleration", "200 rev/s^2")
            drives.write("Target velocity", "1500 rpm")
            drives.write((0x605A, 0), 6)  # hold after the quick stop, as the envelope has it
            drives.advance(0.4)
            if share == 0.0:
                drives.write((0x2042, 1), 0)
                drives.write((0x2042, 2), 0)
            per_second = 200.0 * 65536
            stop = AxisStop(0.0, 25.0 * 65536, per_second, REST_TURNS * 65536, holds=True)
            t, speed, current, marks = [], [], [], []
            for ms in range(260):
                now = ms * 1e-3
                status = int(drives.read(cia402.STATUSWORD)[0])
                actual = float(drives.read(cia402.VELOCITY_ACTUAL)[0])
                was = stop.phase
                word = None if ms == 0 else stop.step(now, Sample(now, status, actual))
                if word is not None:
                    drives.write(cia402.CONTROLWORD, word)
                if stop.phase is not was:
                    marks.append((ms, stop.phase))
                t.append(ms)
                speed.append(actual / 65536 * 60.0)
                current.append(float(drives.read(cia402.TORQUE_ACTUAL)[0]) * 1e-3)
                drives.advance(1e-3)
            speeds.plot(t, speed, color=colour, label=name)
            currents.plot(t, current, color=colour, linewidth=0.9)
            for ms, phase in marks:
                if phase is Phase.CUT:
                    speeds.annotate("voltage off", (ms, speed[ms]), (ms + 25, speed[ms] - 350), fontsize=8, color=RED,
                                    arrowprops={"arrowstyle": "->", "color": RED})  # fmt: skip
                if phase is Phase.REST:
                    speeds.annotate("at rest, held", (ms, speed[ms]), (ms - 30, 350), fontsize=8, color=GREEN,
                                    arrowprops={"arrowstyle": "->", "color": GREEN})  # fmt: skip
    speeds.axvspan(0, 20, color=AMBER, alpha=0.2)
    speeds.axvspan(20, 60, color=GREY, alpha=0.15)
    speeds.text(3, 60, "bus and drive", fontsize=7, color=AMBER, rotation=90)
    speeds.text(23, 60, "two measurements\nof 20 ms each", fontsize=7, color=GREY, rotation=90)
    speeds.set(ylabel="speed [rpm]", ylim=(-250, 1700))
    speeds.legend(fontsize=8, loc="upper right")
    currents.set(xlabel="time after the stop begins [ms]", ylabel="current [A]")
    _save(figure, path)


DIAGRAMS: dict[str, Callable[[], str]] = {
    "emulator-path.svg": emulator_path,
    "emulator-cascade.svg": emulator_cascade,
    "emulator-millisecond.svg": emulator_millisecond,
    "score-parts.svg": score_parts,
    "certificate-steps.svg": certificate_steps,
}
PLOTS: dict[str, Callable[[Path], None]] = {
    "emulator-friction.png": emulator_friction,
    "emulator-imperfections.png": emulator_imperfections,
    "score-move.png": score_move,
    "score-variants.png": score_variants,
    "certificate-bode.png": certificate_bode,
    "certificate-rest.png": certificate_rest,
    "safety-stop.png": safety_stop,
}


def make(names: list[str], folder: Path = FOLDER) -> None:
    """Make the pictures of these names, all without any."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, draw in DIAGRAMS.items():
        if not names or name in names:
            (folder / name).write_text(draw(), encoding="utf-8")
    for name, plot in PLOTS.items():
        if not names or name in names:
            plot(folder / name)


if __name__ == "__main__":
    make(sys.argv[1:])
    if not sys.argv[1:] or "example" in sys.argv[1:]:
        for name, gains, figures in worked_example():
            print(name, gains, {key: round(value, 4) for key, value in figures.items()})
