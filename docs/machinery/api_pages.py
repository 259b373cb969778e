"""The pages of the Python interface: classes and functions for users, by their purpose."""

from __future__ import annotations

FOLDER = "reference/api"
# Page -> title, what it is for, and what it has: the module that users import from, and names in it.
PAGES = {
    "drives": (
        "Drives",
        "A set of drives, emulated or on a bus, reached by objects in the drive's units. Whatever acts on drives takes "
        "either.",
        (
            ("drive_env", "EmulatedDrives CanDrives Trace ObjectAccessError"),
            ("drive_env.drives.interface", "Drives BasicDrives"),
            ("drive_env.drives.emergency", "EmergencyMessage"),
            ("drive_env.dictionary.entries", "ObjectDictionary Entry"),
            ("drive_env.dictionary.roles", "Role"),
        ),
    ),
    "motion": (
        "Motion",
        "Enable, move, home and stop, on any drives: `from drive_env import motion`.",
        (
            (
                "drive_env.drives.motion",
                "enable disable quick_stop reset_fault select_mode wait_for start_move move_to home",
            ),
        ),
    ),
    "machines": (
        "Machines, motors, devices",
        "What drives turn, and what they are: parameters of emulated machines, faults, loads and motors of your own.",
        (
            ("drive_env.emulator.machine", "Machines"),
            ("mechanics", "Load Parameter Friction Contact Switch Roll"),
            ("mechanics.loads", "find_load"),
            ("drive_env.motors", "Motor find_motor MotorError"),
            ("drive_env.devices", "Device find_device device_names"),
            ("drive_env.devices.gain_set", "GainSet Gain"),
        ),
    ),
    "safety": (
        "Safety envelope",
        "The limits around whatever acts on drives on a bus. What they protect, and what they cannot, is in "
        "[Safety](../../safety.md).",
        (("drive_env", "Limits SafetyError"),),
    ),
    "environments": (
        "Environments",
        "The vector environments and what they are made of. Their spaces are on pages of their own: "
        "[Environments](../environments/index.md).",
        (
            ("drive_env.envs", "make_vec_env"),
            ("drive_env.envs.gain_tuning", "GainTuning"),
            ("drive_env.envs.gain_scheduling", "GainScheduling"),
            ("drive_env.envs.tracking", "Tracking"),
            ("drive_env.envs.vector_environment", "VectorEnvironment"),
            ("drive_env.randomisation.random_machines", "Distributions Law Curriculum"),
        ),
    ),
    "tuning": (
        "Tuning",
        "Identification, rules, sweeps, certificates, and what a tuner of your own takes and returns.",
        (
            ("tuning.target", "Target emulated on_bus"),
            ("tuning.outcome", "Outcome"),
            ("tuning.snapshot", "Transaction"),
            ("tuning.runs.sweep", "run SweepResult"),
            ("tuning.runs.sweep_files", "save_sweep"),
            ("tuning.identify.identification", "identify"),
            ("tuning.identify.identified_axis", "Identification"),
            ("drive_env.loops.linear_model", "Plant"),
            ("tuning.rules.rules_by_name", "propose"),
            ("tuning.auto.one_button", "auto"),
            ("drive_env.loops.dynamics", "Dynamics find_dynamics"),
            ("tuning.certificate.certificate", "Certificate AxisCertificate StepResponse FrequencyResponse"),
            ("tuning.certificate.certificate_files", "load_certificate"),
            ("drive_env.drives.raw_gains", "read_gains write_gains"),
        ),
    ),
    "agents": (
        "Agents",
        "The file of a trained agent, and how any policy is opened.",
        (
            ("agents.policies.agent_file", "AgentFile BundleError"),
            ("agents.evaluation.open_policy", "open_policy LoadedPolicy"),
            ("agents.policies.policy", "load_policy measure_latency"),
            ("agents.policies.guard", "GuardLimits GuardedPolicy"),
        ),
    ),
    "pictures": (
        "Pictures",
        "Films and pictures of emulated runs.",
        (
            ("drive_env.pictures.recording", "Recorder Recording"),
            ("drive_env.pictures.render", "render_run frames view Picture"),
            ("drive_env.pictures.demonstration", "PictureFormat"),
        ),
    ),
}
INDEX = """# Python

Classes and functions that are meant for users, from their docstrings. What is named here stays as it is within a
minor version; everything else may change without notice. The packages are typed (`py.typed`).

"""


def pages() -> dict[str, str]:
    """Return the index and the pages."""
    lines = [f"- [{title}]({name}.md): {purpose}" for name, (title, purpose, _) in PAGES.items()]
    made = {f"{FOLDER}/index.md": INDEX + "\n".join(lines) + "\n"}
    for name, (title, purpose, rows) in PAGES.items():
        parts = [f"# {title}\n", f"{purpose}\n"]
        for module, members in rows:
            parts += [f"::: {module}.{member}\n" for member in members.split()]
        made[f"{FOLDER}/{name}.md"] = "\n".join(parts)
    return made
