"""The motors, as rows with their sources. SI; phase values, amplitude-invariant dq, currents as peak i_q.

Catalogue values are line to line: R_s = R_pp / 2, L = L_pp / 2, psi_m = k_t / (sqrt(3) n_p), so that the no-load
speed is that of the catalogue. The torque constant of peak i_q is then 1.5 n_p psi_m = 0.866 k_t.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from mechanics.near_names import did_you_mean


class Motor(NamedTuple):
    """A motor with its encoder: `kind` "pmsm", or "dc" with R_s, L and psi_m those of its one winding and n_p = 1."""

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
    kind: str = "pmsm"
    thermal_time: float = 600.0  # s, winding and housing
    flux_temperature: float = -1.1e-3  # 1/K, of neodymium magnets
    # How its cable is wired: what 2080h:01, 2070h:01 and 2070h:02 of the drive must say.
    encoder_direction: int = 0
    hall_polarity: int = 0
    hall_direction: int = 0

    @property
    def torque_constant(self) -> float:
        """Torque per ampere of peak i_q, of a DC motor per ampere [N*m/A]."""
        return self._phase_factor * self.n_p * self.psi_m

    @property
    def thermal_resistance(self) -> float:
        """Winding to ambient [K/W]: the rated current warms the winding, then of higher resistance, by `RATED_RISE`."""
        hot = self.R_s * (1.0 + COPPER * RATED_RISE)
        return RATED_RISE / (self._phase_factor * hot * self.rated_current**2)

    @property
    def _phase_factor(self) -> float:
        return 1.0 if self.kind == "dc" else 1.5


COPPER = 0.00393  # 1/K, relative change of a winding's resistance
RATED_RISE = 80.0  # K, a class of insulation's common limit at 40 degC ambient


RPM = 0.10471975511965977  # rad/s
_SQRT3 = 3.0**0.5


def _brushed(*, R: float, L: float, k: float, **row: Any) -> Motor:
    """Return a row from a brushed motor's catalogue values: terminal R [ohm], L [H], k [N*m/A = V*s/rad].

    The rotors in this table are coreless or skewed: no cogging.
    """
    return Motor(
        R_s=R,
        L_d=L,
        L_q=L,
        psi_m=k,
        n_p=1,
        cogging_torque=0.0,
        cogging_order=0,
        encoder_line_error=2e-4,
        commutation_offset=0.0,
        kind="dc",
        **row,
    )


def _line_to_line(*, R: float, L: float, k_t: float, n_p: int, **row: Any) -> Motor:
    """Return a row from a brushless motor's catalogue values between two terminals: R [ohm], L [H], k_t [N*m/A].

    The rated current is that of the rated torque, as peak i_q.
    """
    return Motor(
        R_s=R / 2,
        L_d=L / 2,
        L_q=L / 2,
        psi_m=k_t / (_SQRT3 * n_p),
        n_p=n_p,
        rated_current=row["rated_torque"] / (0.5 * _SQRT3 * k_t),
        encoder_line_error=2e-4,
        commutation_offset=0.02,
        **row,
    )


def _class(*, R_s: float, L: float, torque_constant: float, n_p: int, **row: Any) -> Motor:
    """Return a row of class values: phase R_s [ohm] and L [H], torque per ampere of peak i_q [N*m/A]."""
    return Motor(
        R_s=R_s,
        L_d=L,
        L_q=L,
        psi_m=torque_constant / (1.5 * n_p),
        n_p=n_p,
        rated_current=row["rated_torque"] / torque_constant,
        encoder_line_error=2e-4,
        commutation_offset=0.02,
        **row,
    )


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
            encoder_direction=1,
            hall_polarity=1,
            source="torque, current, speed, pole pairs, encoder: vendor listing; flux from rated torque over rated "
            "current; R, L, J are values of its class (L from the maker's demonstration gains); wiring: what the "
            "maker's demonstration programs set in the drive",
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
        _brushed(
            name="qube_servo_3",
            title="Quanser QUBE-Servo 3, coreless DC motor, 18 V, 7 W",
            R=7.5,
            L=1.15e-3,
            k=0.0422,
            inertia=1.4e-6 + 0.6e-6,
            rated_torque=0.022,
            rated_current=0.54,
            rated_speed=3050 * RPM,
            voltage=18.0,
            encoder_counts=2048,
            coulomb=5e-4,
            viscous=5e-7,
            thermal_time=300.0,
            source="R, k, L, J of motor and hub, encoder: user manual of the QUBE-Servo 3; rated voltage, torque, "
            "current and speed: the motor of the QUBE-Servo 2, of the same class; friction and thermal time: class",
        ),
        _class(
            name="class_20w",
            title="Class of small servo motors, 24 V, 20 W",
            R_s=2.2,
            L=0.45e-3,
            torque_constant=0.022,
            n_p=4,
            inertia=0.9e-6,
            rated_torque=0.0318,
            rated_speed=6000 * RPM,
            voltage=24.0,
            encoder_counts=4096,
            cogging_torque=3e-4,
            cogging_order=24,
            coulomb=5e-4,
            viscous=3e-7,
            source="class values throughout: no single motor",
        ),
        _line_to_line(
            name="ec_45_flat",
            title="maxon EC 45 flat, 24 V, 70 W",
            R=0.608,
            L=0.463e-3,
            k_t=0.0369,
            n_p=8,
            inertia=1.81e-5,
            rated_torque=0.128,
            rated_speed=4860 * RPM,
            voltage=24.0,
            encoder_counts=4096,
            cogging_torque=2e-3,
            cogging_order=48,
            coulomb=5e-3,
            viscous=7e-6,
            source="R, k_t, rated torque, pole pairs: catalogue values in public code; L, J, rated speed, friction, "
            "cogging, encoder: class",
        ),
        _brushed(
            name="re_35",
            title="maxon RE 35, coreless DC motor, 30 V, 90 W",
            R=1.2,
            L=0.34e-3,
            k=0.0389,
            inertia=6.81e-6,
            rated_torque=0.0972,
            rated_current=0.0972 / 0.0389,
            rated_speed=6500 * RPM,
            voltage=30.0,
            encoder_counts=2048,
            coulomb=1.5e-3,
            viscous=3e-6,
            source="R, L, k, J, rated torque: catalogue values in public code; current from torque; rated speed, "
            "friction, encoder: class",
        ),
        _brushed(
            name="faulhaber_3863",
            title="Faulhaber 3863 H 024 CR, coreless DC motor, 24 V, 84 W",
            R=0.64,
            L=0.18e-3,
            k=0.0398,
            inertia=1.2e-5,
            rated_torque=0.157,
            rated_current=(0.157 + 0.0065) / 0.0398,
            rated_speed=5100 * RPM,
            voltage=24.0,
            encoder_counts=4096,
            coulomb=6.5e-3,
            viscous=1e-6,
            thermal_time=900.0,
            source="R, L, k, J, friction torque, largest continuous torque, thermal time: data sheet of 2012; current "
            "from torque and friction; speed at that current; viscous friction, encoder: class",
        ),
        _brushed(
            name="re_40",
            title="maxon RE 40, coreless DC motor, 48 V, 150 W",
            R=1.13,
            L=0.33e-3,
            k=0.0603,
            inertia=1.37e-5,
            rated_torque=0.187,
            rated_current=3.17,
            rated_speed=7000 * RPM,
            voltage=48.0,
            encoder_counts=2048,
            coulomb=3e-3,
            viscous=1.4e-6,
            thermal_time=809.0,
            source="electrical, mechanical and thermal values: catalogue sheet in public code; friction: its no-load "
            "current of 68.6 mA, split by class; encoder: class",
        ),
        _line_to_line(
            name="ec_60_flat",
            title="maxon EC 60 flat, 24 V, 150 W",
            R=0.293,
            L=0.279e-3,
            k_t=0.0525,
            n_p=7,
            inertia=8.1e-5,
            rated_torque=0.401,
            rated_speed=3480 * RPM,
            voltage=24.0,
            encoder_counts=4096,
            cogging_torque=4e-3,
            cogging_order=42,
            coulomb=1.2e-2,
            viscous=2e-5,
            thermal_time=69.9,
            source="R, L, k_t, J, rated torque and speed, thermal time: article 625858 in R. Klein's thesis, FAU "
            "Erlangen 2023; current from torque, 5 % above its 7.25 A; pole pairs, friction, cogging, encoder: class",
        ),
        _class(
            name="teknic_m2310p",
            title="Teknic M-2310P-LN-04K, 40 V, 170 W",
            R_s=0.36,
            L=0.2e-3,
            torque_constant=1.5 * 4.64 / (_SQRT3 * 1000 * RPM),
            n_p=4,
            inertia=7.061551833333e-6,
            rated_torque=0.2724,
            rated_speed=6000 * RPM,
            voltage=40.0,
            encoder_counts=4000,
            cogging_torque=2e-3,
            cogging_order=24,
            coulomb=3e-3,
            viscous=2.636875217824e-6,
            source="R, L, back-EMF of 4.64 V line peak per 1000 rpm, J, viscous friction, rated torque, speed, encoder "
            "and voltage: motor files of public field-oriented control projects; dry friction, cogging: class",
        ),
        _line_to_line(
            name="nanotec_db59",
            title="Nanotec DB59L024035-A, 24 V, 172 W",
            R=2 * 0.22,
            L=2 * 0.29e-3,
            k_t=0.05,
            n_p=3,
            inertia=2.4e-5,
            rated_torque=0.47,
            rated_speed=3500 * RPM,
            voltage=24.0,
            encoder_counts=4096,
            cogging_torque=8e-3,
            cogging_order=18,
            coulomb=6e-3,
            viscous=8e-6,
            source="phase R and L, torque constant (taken line to line, as 4500 rpm without load needs), pole pairs, "
            "rated torque and power: Synapticon's public motor files; J, friction, cogging, encoder: class",
        ),
        _line_to_line(
            name="nanotec_db87",
            title="Nanotec DB87S01, 48 V, 220 W",
            R=2 * 0.18,
            L=2 * 0.35e-3,
            k_t=0.7 / 6.25,
            n_p=4,
            inertia=7e-5,
            rated_torque=0.7,
            rated_speed=3000 * RPM,
            voltage=48.0,
            encoder_counts=4096,
            cogging_torque=1.2e-2,
            cogging_order=24,
            coulomb=1e-2,
            viscous=1.5e-5,
            source="phase R and L, pole pairs, rated torque, current, power: Synapticon's public motor files; torque "
            "constant from torque over current; voltage, J, friction, cogging, encoder: class",
        ),
        _brushed(
            name="re_65",
            title="maxon RE 65, DC motor, 48 V, 250 W",
            R=0.365,
            L=0.161e-3,
            k=0.123,
            inertia=1.34e-4,
            rated_torque=0.8,
            rated_current=6.8,
            rated_speed=3420 * RPM,
            voltage=48.0,
            encoder_counts=4096,
            coulomb=2.5e-2,
            viscous=2.7e-5,
            thermal_time=1060.0,
            source="electrical, mechanical and thermal values: catalogue sheet of 353297 in public code; friction: its "
            "no-load current of 289 mA, split by class; encoder: class",
        ),
        _class(
            name="class_400w",
            title="Class of 60 mm servo motors, 48 V, 400 W",
            R_s=0.12,
            L=0.2e-3,
            torque_constant=0.1,
            n_p=5,
            inertia=2.8e-5,
            rated_torque=1.27,
            rated_speed=3000 * RPM,
            voltage=48.0,
            encoder_counts=10_000,
            cogging_torque=1.5e-2,
            cogging_order=60,
            coulomb=2e-2,
            viscous=2e-5,
            thermal_time=1200.0,
            source="class values throughout: no single motor",
        ),
        _class(
            name="class_750w",
            title="Class of 80 mm servo motors, 48 V, 750 W",
            R_s=0.05,
            L=0.1e-3,
            torque_constant=0.11,
            n_p=5,
            inertia=1.2e-4,
            rated_torque=2.39,
            rated_speed=3000 * RPM,
            voltage=48.0,
            encoder_counts=10_000,
            cogging_torque=2.5e-2,
            cogging_order=60,
            coulomb=3.5e-2,
            viscous=4e-5,
            thermal_time=1500.0,
            source="class values throughout: no single motor",
        ),
        _class(
            name="class_1kw",
            title="Class of large 80 mm servo motors, 48 V, 1000 W",
            R_s=0.03,
            L=0.08e-3,
            torque_constant=0.11,
            n_p=5,
            inertia=1.8e-4,
            rated_torque=3.18,
            rated_speed=3000 * RPM,
            voltage=48.0,
            encoder_counts=10_000,
            cogging_torque=3e-2,
            cogging_order=60,
            coulomb=4e-2,
            viscous=5e-5,
            thermal_time=1800.0,
            source="class values throughout: no single motor",
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
        raise ValueError(
            f"no motor is named {name!r}; there are {', '.join(sorted(MOTORS))}{did_you_mean(name, MOTORS)}"
        )
    return MOTORS[name]
