"""The motors, as rows with their sources. SI; phase values, amplitude-invariant dq, currents as peak i_q.

Catalogue values are line to line: R_s = R_pp / 2, L = L_pp / 2, psi_m = k_t / (sqrt(3) n_p), so that the no-load
speed is that of the catalogue. The torque constant of peak i_q is then 1.5 n_p psi_m = 0.866 k_t.
"""

from __future__ import annotations

from typing import NamedTuple


class Motor(NamedTuple):
    """A permanent-magnet synchronous motor with its encoder."""

    name: str
    title: str
    R_s: float  # ohm
    L_d: float  # H
    L_q: float  # H
    psi_m: float  # V s
    n_p: int
    inertia: float  # kg m^2, rotor
    rated_torque: float  # N m
    rated_current: float  # A, peak i_q
    rated_speed: float  # rad/s
    voltage: float  # V
    encoder_counts: int  # per turn, after quadrature
    cogging_torque: float  # N m, amplitude
    cogging_order: int  # periods per turn
    coulomb: float  # N m, bearings
    viscous: float  # N m s/rad
    encoder_line_error: float  # rad, once per turn
    commutation_offset: float  # rad electrical, left after alignment
    source: str

    @property
    def torque_constant(self) -> float:
        """Torque per ampere of peak i_q [N*m/A]."""
        return 1.5 * self.n_p * self.psi_m


RPM = 0.10471975511965977  # rad/s
_SQRT3 = 3.0**0.5

MOTORS: dict[str, Motor] = {
    row.name: row
    for row in (
        Motor(
            name="qbl4208",
            title="Trinamic QBL4208-61-04-013-1024-AT, 24 V, 52 W",
            R_s=0.36,
            L_d=0.6e-3,
            L_q=0.6e-3,
            psi_m=0.125 / 3.5 / (1.5 * 4),
            n_p=4,
            inertia=4.8e-6,
            rated_torque=0.125,
            rated_current=3.5,
            rated_speed=4000 * RPM,
            voltage=24.0,
            encoder_counts=4096,
            cogging_torque=1.5e-3,
            cogging_order=24,
            coulomb=1.5e-3,
            viscous=1.5e-6,
            encoder_line_error=2e-4,
            commutation_offset=0.02,
            source="torque, current, speed, pole pairs, encoder: vendor listing; flux from rated torque over rated "
            "current; R, L, J are values of its class (L from the maker's demonstration gains)",
        ),
        Motor(
            name="ec_i_40",
            title="maxon EC-i 40, 36 V, 70 W",
            R_s=0.807 / 2,
            L_d=0.644e-3 / 2,
            L_q=0.644e-3 / 2,
            psi_m=0.0315 / (_SQRT3 * 7),
            n_p=7,
            inertia=2.42e-6,
            rated_torque=0.0665,
            rated_current=0.0665 / (0.0315 * 0.5 * _SQRT3),
            rated_speed=9400 * RPM,
            voltage=36.0,
            encoder_counts=4096,
            cogging_torque=4e-4,
            cogging_order=42,
            coulomb=1.2e-3,
            viscous=8e-7,
            encoder_line_error=2e-4,
            commutation_offset=0.02,
            source="R, L, k_t, no-load speed 10,700 rpm, J: catalogue values in public code; rated point of its class",
        ),
    )
}

# Ranges of randomisation as multiples of the row's value: unit-to-unit spread and temperature.
RANGES = {
    "R_s": (0.85, 1.4),
    "L_d": (0.85, 1.15),
    "L_q": (0.85, 1.15),
    "psi_m": (0.88, 1.05),
    "inertia": (0.9, 1.1),
    "cogging_torque": (0.0, 2.0),
    "coulomb": (0.3, 2.5),
    "viscous": (0.3, 3.0),
    "encoder_line_error": (-2.0, 2.0),
    "commutation_offset": (-3.0, 3.0),
}


def find_motor(name: str) -> Motor:
    """Return the row of a motor; ValueError lists the names there are."""
    if name not in MOTORS:
        raise ValueError(f"no motor is named {name!r}; there are {', '.join(sorted(MOTORS))}")
    return MOTORS[name]
