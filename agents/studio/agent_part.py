"""The part of the page Tune in which a trained agent tunes the axes, trial by trial."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from nicegui import ui

from drive_env.devices import find_device
from drive_env.loops.dynamics import DEFAULT
from drive_env.studio.parts import StudioPart
from drive_env.studio.sentences import sentence

if TYPE_CHECKING:
    from agents.tuner.tune_target import TrialShown
    from tuning.studio.tune_desk import TunerSession
    from tuning.studio.tuner_card import TunerCard
    from tuning.target import Target

TRIALS_SHARE = (0.3, 0.68)  # shares of a run's progress at which its trials begin and end


def build(card: TunerCard) -> None:
    """Add the agent's controls to the card of tuners."""
    from agents.shipped import TUNER
    from agents.tuner.open_tuner import open_tuner

    panel = card.panel
    ui.separator()
    ui.label(
        "A trained agent tries gains on the axes, trial by trial, and then goes through the same checks as auto. "
        "PyTorch is not needed."
    ).classes("studio-hint")
    with ui.row().classes("studio-buttons"):
        agent = ui.input("Agent (a name, or a file .npz)", value=TUNER).props("dense outlined data-test=agent")
        agent.classes("grow")
        trials = ui.number("Trials (empty: its own)", min=1, max=10_000).props("dense outlined data-test=trials")

        async def start() -> None:
            try:
                policy = open_tuner(str(agent.value), panel.device.name, int(trials.value) if trials.value else None)
            except Exception as error:
                panel.visitor.say(sentence(error), "error")
                return
            name = str(agent.value)
            store = not panel.desk.is_emulated
            await card.start(f"agent {name}", "agent-tune", work_of(policy, name, store), columns_of(panel.device.name))

        ui.button("Run the agent", icon="smart_toy", on_click=start).props("unelevated no-caps data-test=run-agent")


def columns_of(device: str) -> tuple[str, ...]:
    """Return the column titles of the table of trials."""
    from agents.tuner.open_tuner import titles_of_trials

    return ("Trial", *titles_of_trials(find_device(device).gains), "J (less is better)", "")


def work_of(policy: Any, name: str, store: bool) -> Callable[[Target, TunerSession, Callable[[str, float], None]], Any]:
    """Return the function that runs the agent like `drive-tune auto --by agent`, with its files in the run's folder."""

    def work(target: Target, run: TunerSession, progress: Callable[[str, float], None]) -> Any:
        from agents.tuner.known_range import outside
        from agents.tuner.open_tuner import remark
        from agents.tuner.tuning_run import method_of
        from tuning.auto_to_files import auto_to_files

        outer = target.device.gains.columns_of("velocity", "position")
        low, high = TRIALS_SHARE
        count = int(policy.bundle.configuration["trials"])

        def show(trial: TrialShown) -> None:
            figures = [str(value) for value in trial.gains[0, outer]]
            run.trials.append((str(trial.number or "rule"), *figures, f"{trial.measured[0]:.3f}", remark(trial)))
            progress("trials", low + (high - low) * trial.number / max(1, count))

        run.folder.mkdir(parents=True, exist_ok=True)
        doubts = outside(policy.bundle, target, None if target.bus else target.machine)
        for doubt in doubts:
            progress(doubt, 0.0)
        method = method_of(policy, name, doubts, show, lambda what: progress(what, low))
        dynamics = policy.bundle.configuration.get("dynamics", DEFAULT)
        return auto_to_files(target, run.folder, progress, keep=store, dynamics=dynamics, method=method)

    return work


part = StudioPart("/tune", 10, build)
