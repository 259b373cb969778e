"""`drive-agent margins`: the sensitivity of loops with a policy in them, and an agent that keeps margins."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from agents.commands.options import REFUSED, Json, Trust, errors_as_exit_codes, fail, print_json, progress_bar

if TYPE_CHECKING:
    from agents.policies.agent_file import AgentFile


def margins(
    policy: Annotated[str, typer.Argument(help="The policy, as evaluate takes it: an agent, a file, a baseline.")],
    environment: Annotated[
        str | None, typer.Option("--environment", "-e", help="Environment, for a policy whose file does not name it.")
    ] = None,
    dynamics: Annotated[
        str | None,
        typer.Option(
            "--dynamics", help="Whose Ms the loops must keep: soft, standard or stiff; exit code 1 if they do not."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Write the agent to this .npz, answering following errors by as much less as --dynamics asks for.",
        ),
    ] = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Measure the greatest sensitivity Ms of every axis with a policy in its loops, on 32 emulated machines.

    Of Tracking and its tasks. Each episode is run twice, alike but for a small torque on one axis: how much of it the
    loops answer is their sensitivity, 1/(1 + L), whatever the policy is. Ms of 2 leaves a phase margin of 29 degrees
    and a gain margin of 6 dB at least.
    """
    with errors_as_exit_codes():
        from agents.commands.evaluate import opened_for
        from agents.commands.train import judged
        from agents.evaluation.loop_sensitivity import NotKeptError, check_kept, figures, measure_sensitivity, within
        from drive_env.loops.dynamics import find_dynamics

        if out is not None and (dynamics is None or out.suffix != ".npz"):
            raise ValueError("--out FILE.npz writes an agent that keeps --dynamics; give both, and that ending")
        if out is not None and out.exists():
            raise ValueError(f"--out {out} is there already; give a new file")
        asked = None if dynamics is None else find_dynamics(dynamics)
        loaded, configuration = opened_for(policy, environment, trust=trust)
        bundle: AgentFile | None = getattr(loaded.policy, "bundle", None)
        try:
            with progress_bar(f"loops with {loaded.name}") as show:
                if out is not None and asked is not None:
                    if bundle is None or "observation_scale" not in bundle.arrays:
                        raise ValueError(
                            f"{policy} was not trained by drive-agent, and --out changes only such agents; leave it out"
                        )
                    agent, found = within(bundle, asked, told=show)
                else:
                    found = measure_sensitivity(loaded.policy, loaded.environment, configuration, told=show)
            table = figures(found)
            if out is not None:
                judged(agent)[0].save(out)
            if json:
                print_json(
                    {"policy": loaded.name, "environment": loaded.environment, **table, "each": found.ms.tolist()}
                )
            else:
                print(f"{loaded.name} in {loaded.environment}, {len(found.ms)} machines of {found.ms.shape[1]} axes")
                print(", ".join(f"{name} {value:.2f}" for name, value in table.items()))
            if asked is not None:
                check_kept(found, asked)
        except NotKeptError as error:
            fail(error, REFUSED)
        if not json:
            if asked is not None:
                print(
                    f"Ms is within {asked.name} ({asked.ms:g}); phase and gain margins by themselves are not measured"
                )
            if out is not None:
                print(f"written to {out}: answers following errors by {agent.card['margins']['answer to errors']:g} "
                      "of what it did")  # fmt: skip
