"""Calibration of the IMU against the odometry, by comparing rotations.

:func:`calibrate` runs the odometry over a recording, each time with what is known of the IMU so
far: a rotation or a delay of the samples that deskew a sweep moves its pose a little.

:class:`ExtrinsicCheck` watches a running odometry and only reports. The rotation of the IMU and
the delay of its stamps stay what they are set to: an odometry that follows its own errors hides
them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.calibration.file import ImuCalibration
from l2lidar_node.calibration.result import Estimate, Refusal, Verdict
from l2lidar_node.types import F64, IMU_SAMPLE, Sweep
from l2lidar_proc.motion import gyro_alignment as gyro
from l2lidar_proc.motion.config import ImuConfig
from l2lidar_proc.motion.gyro_alignment import GyroAlignment, GyroError, GyroModel, Turns
from l2lidar_proc.motion.imu_buffer import Samples, replay
from l2lidar_proc.motion.imu_corrections import ImuExtrinsics
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.estimate import CUTS, OdometryEstimate
from l2lidar_proc.odometry.odometry import Odometry


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuParameter:
    """One parameter of an IMU; deviations are in its own unit (rad, 1, rad/s, s).

    Attributes
    ----------
    name : str
    unit : str
        For people.
    factor : float
        From its own unit to that.
    model_sd : float
        What gyro and odometry are off beyond what the recording shows, with calibrated beams.
        From virtual units: a gyro line in step with the head turns with the motion and leaves 0.04
        degrees in rotations, poses leave up to 0.02 % in scales.
    reported_sd : float
        What beams as reported add to that. Their error is fixed in the sensor, so the pose is off
        by what depends on how it is turned: a part of every turn, as a scale is. No part of the
        recording says otherwise. Over virtual units 3 and 11 to 14 it was 0.06 degrees, 0.07 %,
        0.8 mrad and 0.1 ms at the most.
    largest_sd : float
        Beyond that nothing is known that the drawing does not say as well: half of its tolerance
        for scales (1 %), a seventh for rotations (2 degrees), since twice as much shows in a
        sweep.
    prior_sd : float
        What the check in a running odometry begins with. A misalignment of 2 mrad is what data
        sheets allow; without that a robot that only turns about one axis could not tell a rotation
        about the others from it.
    """

    name: str
    unit: str
    factor: float
    model_sd: float
    reported_sd: float
    largest_sd: float
    prior_sd: float


IMU_PARAMETERS: Final = (
    *(
        ImuParameter(
            name=f"rotation {axis}",
            unit="deg",
            factor=float(np.rad2deg(1.0)),
            model_sd=float(np.deg2rad(0.04)),
            reported_sd=float(np.deg2rad(0.05)),
            largest_sd=float(np.deg2rad(0.3)),
            prior_sd=float(np.deg2rad(20.0)),
        )
        for axis in "xyz"
    ),
    *(
        ImuParameter(
            name=f"scale {axis}",
            unit="%",
            factor=100.0,
            model_sd=2e-4,
            reported_sd=5e-4,
            largest_sd=5e-3,
            prior_sd=0.02,
        )
        for axis in "xyz"
    ),
    *(
        ImuParameter(
            name=f"skew {axes}",
            unit="mrad",
            factor=1e3,
            model_sd=5e-4,
            reported_sd=5e-4,
            largest_sd=5e-3,
            prior_sd=0.002,
        )
        for axes in ("xy", "xz", "yz")
    ),
    *(
        ImuParameter(
            name=f"bias {axis}",
            unit="rad/s",
            factor=1.0,
            model_sd=1.5e-3,
            reported_sd=0.0,
            largest_sd=2e-2,
            prior_sd=0.2,
        )
        for axis in "xyz"
    ),
    ImuParameter(
        name="time offset",
        unit="ms",
        factor=1e3,
        model_sd=5e-5,
        reported_sd=1e-4,
        largest_sd=1e-3,
        prior_sd=0.05,
    ),
)
"""Parameters in the order of :mod:`gyro_alignment`."""

_MODEL_SD: Final = np.array([one.model_sd for one in IMU_PARAMETERS])
_REPORTED_SD: Final = np.array([one.reported_sd for one in IMU_PARAMETERS])
_LARGEST_SD: Final = np.array([one.largest_sd for one in IMU_PARAMETERS])
_PRIOR_SD: Final = np.array([one.prior_sd for one in IMU_PARAMETERS])

ENOUGH: Final = 10.0
"""Excitation of an axis [rad^2/s] that gives rotations to 0.05 degrees and scales to 0.1 %.

1 rad/s for 10 s: with poses good to 0.05 degrees at 4.35 Hz and 0.04 rad/s of gyro noise the rate
of an interval is known to 0.0036 rad/sqrt(s), and the square root of the excitation divides it.
"""

_SIGNIFICANT: Final = 2.0  # standard deviations of a correction that is worth having
_PASSES: Final = 3
_SETTLED: Final = 0.3  # of a standard deviation, between passes
_FEWEST_ALIGNED: Final = 0.8  # of the sweeps
_SHORTEST_S: Final = 15.0
_LEAST_EXCITATION: Final = 0.5  # [rad^2/s]
_LARGEST_ROTATION: Final = np.deg2rad(15.0)
_LARGEST_OFFSET_S: Final = 0.1
_LARGEST_RESIDUAL: Final = np.deg2rad(0.6)  # of a turn between two sweeps
_CONTRADICTION: Final = 6.0  # standard deviations by which a part may differ from the others

# ---- of the check in a running odometry

_PART_NS: Final = 5_000_000_000
_FEWEST_PARTS: Final = 5
_MOST_PARTS: Final = 60  # five minutes: what is looked back on
_FEWEST_TURNS: Final = 10  # between poses, in a part that counts
_MOST_POSES: Final = 1000  # in a part, whatever their stamps are
_MOST_SAMPLES: Final = 20_000
_PART_EXCITATION: Final = 0.2  # [rad^2/s] in a part: less is standing, which tells nothing

# A degree costs 2 mm on a walk of 20 m, and shows in a deskewed sweep; less is not worth a word.
_WORTH_SAYING: Final = np.deg2rad(1.0)
_WORTH_SAYING_S: Final = 4e-3
_KNOWN: Final = np.deg2rad(0.25)
_KNOWN_S: Final = 1e-3
_CERTAIN: Final = 4.0  # standard deviations: an error that is reported

Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True, eq=False)
class ImuResult:
    """Result of an IMU calibration.

    Attributes
    ----------
    estimates : dict of Estimate
        By the names of :data:`IMU_PARAMETERS`.
    weakest : str
        What is known worst, in words.
    refusals : tuple of Refusal
        Why nothing may be written; empty if it may.
    notes : tuple of str
    alignment : GyroAlignment
    before : Turns
        What was off from sweep to sweep under the drawing, but for the bias; what is left now
        is in the alignment.
    seconds : float
        Of the recording.
    sweeps, aligned : int
    """

    estimates: dict[str, Estimate]
    weakest: str
    refusals: tuple[Refusal, ...]
    notes: tuple[str, ...]
    alignment: GyroAlignment
    before: Turns
    seconds: float
    sweeps: int
    aligned: int

    @property
    def is_corrected(self) -> bool:
        """Whether there is anything to store."""
        return not self.refusals and any(
            item.verdict is Verdict.CORRECTED for item in self.estimates.values()
        )

    def calibration(self) -> ImuCalibration:
        """Return the values to store; unknown or correct ones are as in the drawing."""
        values = [
            item.value if item.verdict is Verdict.CORRECTED else 0.0
            for item in self.estimates.values()
        ]
        x, y, z = rotations.to_rpy(
            rotations.matrices(rotations.exp(values[gyro.ROTATION]))
        ).tolist()
        bias = [self.estimates[f"bias {axis}"].value for axis in "xyz"]
        return ImuCalibration(
            (x, y, z),
            values[gyro.OFFSET],
            (bias[0], bias[1], bias[2]),
            (values[3], values[4], values[5]),
            (values[6], values[7], values[8]),
            {
                name.replace(" ", "_"): item.sd
                for name, item in self.estimates.items()
                if np.isfinite(item.sd)
            },
        )


def calibrate(
    sweeps: Sequence[Sweep],
    samples: Samples,
    config: OdometryConfig | None = None,
    progress: Progress = lambda share: None,
    *,
    beams_calibrated: bool = False,
) -> ImuResult:
    """Estimate the errors of an IMU.

    Parameters
    ----------
    sweeps : sequence of Sweep
        Of full turns, in order; not deskewed.
    samples : ndarray, shape (N,), dtype IMU_SAMPLE
        As measured, in order.
    config : OdometryConfig, optional
    progress : callable
        Told the share that is done, 0 to 1.
    beams_calibrated : bool
        Whether the sweeps are those of calibrated beams; else the deviations are larger.

    Raises
    ------
    GyroError
        If nothing can be estimated; the message says why and what to do.
    """
    if not len(samples):
        raise GyroError(
            "there are no IMU samples: switch the IMU on (l2lidar set work-mode -- -imu_off), "
            "and record for 30 s"
        )
    if not sweeps:
        raise GyroError(
            "there are no 3D sweeps: set the unit to 3D (l2lidar set work-mode -- -mode_2d)"
        )
    config = config or OdometryConfig()
    model_sd = _model_sd(beams_calibrated)
    found: GyroAlignment | None = None
    estimates: list[OdometryEstimate] = []
    for number in range(_PASSES):

        def told(share: float, number: int = number) -> None:
            progress((number + share) / _PASSES)

        model = found.model if found else GyroModel.ideal()
        estimates = _poses(sweeps, samples, config, model, told)
        before = found
        found = _aligned(estimates, samples, model)
        if before is not None and _is_same(before, found, model_sd):
            break
    assert found is not None
    progress(1.0)
    return judged(found, estimates, sweeps, samples, model_sd)


def _poses(
    sweeps: Sequence[Sweep],
    samples: Samples,
    config: OdometryConfig,
    model: GyroModel,
    progress: Progress,
) -> list[OdometryEstimate]:
    """Return the odometry of the recording with an IMU that is known so far."""
    known = ImuExtrinsics(model.rotation, 1e3 * model.offset_s, model.unmixing)
    odometry = Odometry(config, known.mounted(ImuConfig().T_cloud_imu))
    right = known.corrected(samples)
    estimates: list[OdometryEstimate] = []
    for number, (sweep, some) in enumerate(replay(sweeps, right)):
        odometry.imu(some)
        estimates += odometry.register(sweep)
        progress((number + 1) / len(sweeps))
    return estimates


def _aligned(
    estimates: Sequence[OdometryEstimate], samples: Samples, model: GyroModel
) -> GyroAlignment:
    stamps, turns = _aligned_turns(estimates)
    if not len(stamps):
        raise GyroError(
            "no sweep could be aligned; record in a furnished room, and turn more slowly"
        )
    return gyro.align(stamps, turns, samples, model)


def _aligned_turns(estimates: Sequence[OdometryEstimate]) -> tuple[NDArray[np.int64], F64]:
    """Return stamps (N,) [ns] and attitudes (N, 4), wxyz, of the sweeps that were aligned."""
    good = [item for item in estimates if item.is_aligned]
    stamps = np.array([item.stamp for item in good], dtype=np.int64)
    return stamps, np.array([rotations.from_matrix(item.T_map_lidar[:3, :3]) for item in good])


def _model_sd(beams_calibrated: bool) -> F64:
    return _MODEL_SD if beams_calibrated else np.hypot(_MODEL_SD, _REPORTED_SD)


def _is_same(before: GyroAlignment, after: GyroAlignment, model_sd: F64) -> bool:
    away = np.abs(after.model.values - before.model.values)
    away[gyro.BIAS] = 0.0  # nothing is computed with it
    return bool((away < _SETTLED * np.hypot(after.sd, model_sd)).all())


def judged(
    found: GyroAlignment,
    estimates: Sequence[OdometryEstimate],
    sweeps: Sequence[Sweep],
    samples: Samples,
    model_sd: F64 = _MODEL_SD,
) -> ImuResult:
    """Return the result of an alignment: verdicts, refusals, worst-known parameters.

    Parameters
    ----------
    found : GyroAlignment
    estimates : sequence of OdometryEstimate
        It comes from.
    sweeps : sequence of Sweep
    samples : ndarray, shape (N,), dtype IMU_SAMPLE
        As measured.
    model_sd : ndarray, shape (13,)
        What the estimates are off beyond what the recording shows.
    """
    seconds = (sweeps[-1].end - sweeps[0].start) * 1e-9
    aligned = sum(item.is_aligned for item in estimates)
    sd = np.hypot(found.sd, model_sd)
    items = {
        one.name: _estimate(number, float(found.model.values[number]), float(sd[number]), found)
        for number, one in enumerate(IMU_PARAMETERS)
    }
    drawn = GyroModel.of(np.where(_is_bias(), found.model.values, 0.0))
    stamps, turns = _aligned_turns(estimates)
    return ImuResult(
        items,
        _weakest(sd, found),
        tuple(_refusals(found, model_sd, seconds, aligned, len(sweeps))),
        tuple(_notes(items, found)),
        found,
        gyro.turns_between(stamps, turns, samples, drawn),
        seconds,
        len(sweeps),
        aligned,
    )


def _is_bias() -> F64:
    mask = np.zeros(gyro.PARAMETERS)
    mask[gyro.BIAS] = 1.0
    return mask


def _estimate(number: int, value: float, sd: float, found: GyroAlignment) -> Estimate:
    """Return one parameter with its verdict."""
    if gyro.BIAS.start <= number < gyro.BIAS.stop:
        reason = "deskew and odometry estimate it themselves" if number == gyro.BIAS.start else ""
        return Estimate(value, sd, Verdict.SHOWN, reason)
    if sd > _LARGEST_SD[number]:
        return Estimate(value, sd, Verdict.UNKNOWN, f"turn more about {_needed(number, found)}")
    if abs(value) < _SIGNIFICANT * sd:
        return Estimate(value, sd, Verdict.UNCHANGED)
    return Estimate(value, sd, Verdict.CORRECTED)


def _needed(number: int, found: GyroAlignment) -> str:
    """Return the axes to turn about to determine a parameter."""
    if number < gyro.ROTATION.stop:
        axes = [axis for axis in range(3) if axis != number]
    elif number < gyro.SCALE.stop:
        axes = [number - gyro.SCALE.start]
    elif number < gyro.SKEW.stop:
        axes = list(((0, 1), (0, 2), (1, 2))[number - gyro.SKEW.start])
    else:
        axes = [0, 1, 2]
    weak = [axis for axis in axes if found.excitation[axis] < ENOUGH] or axes
    return " and ".join("xyz"[axis] for axis in weak)


def _weakest(sd: F64, found: GyroAlignment) -> str:
    """Return in words which direction of the rotation is known worst."""
    values, vectors = np.linalg.eigh(found.covariance[gyro.ROTATION, gyro.ROTATION])
    axis = vectors[:, -1]
    name = "xyz"[int(np.argmax(np.abs(axis)))]
    worst = max(float(np.sqrt(values[-1])), float(sd[gyro.ROTATION].max()))
    return (
        f"the rotation about {name} ({np.rad2deg(worst):.3f} degrees): turn about the other two "
        "axes to determine it"
    )


def _refusals(
    found: GyroAlignment, model_sd: F64, seconds: float, aligned: int, sweeps: int
) -> list[Refusal]:
    """Return why nothing can be believed."""
    again = "in a furnished room, rotate and shake it vigorously about all three axes for 30 s"
    refusals = []
    if seconds < _SHORTEST_S:
        refusals.append(
            Refusal(f"{seconds:.0f} s of recording, {_SHORTEST_S:.0f} s are needed", again)
        )
    if aligned < _FEWEST_ALIGNED * sweeps:
        refusals.append(
            Refusal(
                f"the odometry failed: only {aligned} of {sweeps} sweeps could be aligned",
                "turn more slowly, below 3 rad/s, in a furnished room of 4 to 10 m",
            )
        )
    if found.excitation.max() < _LEAST_EXCITATION:
        refusals.append(Refusal("the sensor hardly turned", again))
    if found.turns.rms > _LARGEST_RESIDUAL:
        refusals.append(
            Refusal(
                f"gyro and clouds differ by {np.rad2deg(found.turns.rms):.2f} degrees from "
                "sweep to sweep: they do not turn together",
                "check that the IMU is the sensor's own and that the scene is still",
            )
        )
    rotation = float(np.linalg.norm(found.model.values[gyro.ROTATION]))
    if rotation > _LARGEST_ROTATION:
        refusals.append(
            Refusal(
                f"an IMU rotated by {np.rad2deg(rotation):.0f} degrees is not a calibration error",
                "set its mount in /tf_static or imu_rpy",
            )
        )
    if abs(found.model.offset_s) > _LARGEST_OFFSET_S:
        refusals.append(
            Refusal(
                f"a time offset of {1e3 * found.model.offset_s:.0f} ms cannot be that of the "
                f"L2's IMU",
                "record the unit itself: l2lidar record",
            )
        )
    refusals += _contradictions(found, model_sd)
    return refusals


def _contradictions(found: GyroAlignment, model_sd: F64) -> list[Refusal]:
    """Return whether one part of the recording contradicts the others."""
    which = [*range(gyro.ROTATION.stop), gyro.OFFSET]
    away = np.abs(found.parts[:, which] - found.model.values[which])
    own = np.hypot(found.parts_sd[:, which], model_sd[which])
    limit = np.maximum(_CONTRADICTION * own, _LARGEST_SD[which])
    part, column = np.unravel_index(int(np.argmax(away / limit)), away.shape)
    if away[part, column] <= limit[part, column]:
        return []
    parameter = IMU_PARAMETERS[which[column]]
    return [
        Refusal(
            f"part {part + 1} of {len(away)} of the recording says {parameter.name} "
            f"{away[part, column] * parameter.factor:.2f} {parameter.unit} off the others",
            "fasten what is loose, keep people out, and record again",
        )
    ]


def _notes(items: dict[str, Estimate], found: GyroAlignment) -> list[str]:
    notes = []
    unknown = [name for name, item in items.items() if item.verdict is Verdict.UNKNOWN]
    if unknown:
        notes.append(
            f"not determined by this motion, so left as in the drawing: {', '.join(unknown)}"
        )
    if found.outliers > 0.1 * len(found.turns.ends):
        notes.append(
            f"{found.outliers} of {len(found.turns.ends)} turns between sweeps are far off; check "
            "whether something hit the sensor or blocked its view"
        )
    return notes


class ExtrinsicCheck:
    """Compares poses with the gyro, segment by segment.

    Parameters
    ----------
    rotation : ndarray, shape (3, 3)
        IMU axes to cloud axes, as they are used.

    Attributes
    ----------
    finding : str
        What looks wrong, for people; empty while nothing does.
    """

    def __init__(self, rotation: F64) -> None:
        self._model = GyroModel(rotation, np.zeros(3), np.zeros(3), np.zeros(3), 0.0)
        self._parts: list[tuple[F64, F64]] = []
        self._change: F64 | None = None
        self._sd = np.full(gyro.PARAMETERS, np.inf)
        self.finding = ""
        self._begin()

    def _begin(self) -> None:
        self._stamps: list[int] = []
        self._turns: list[F64] = []
        self._samples: list[Samples] = []
        self._count = 0

    @property
    def values(self) -> dict[str, str]:
        """Figures for a diagnostic status; empty while nothing is known."""
        found: dict[str, str] = {}
        if self._change is None:
            return found
        if (self._sd[gyro.ROTATION] < _KNOWN).any():
            found["extrinsic rotation off, x y z [deg]"] = " ".join(
                f"{np.degrees(value):+.2f}" if sd < _KNOWN else "?"
                for value, sd in zip(
                    self._change[gyro.ROTATION], self._sd[gyro.ROTATION], strict=True
                )
            )
        if self._sd[gyro.OFFSET] < _KNOWN_S:
            found["IMU time offset off [ms]"] = f"{1e3 * self._change[gyro.OFFSET]:+.2f}"
        return found

    def imu(self, samples: Samples) -> None:
        """Take samples (N,) as the odometry uses them."""
        if not len(samples) or self._count > _MOST_SAMPLES:
            return
        self._samples.append(samples)
        self._count += len(samples)

    def pose(self, estimate: OdometryEstimate) -> None:
        """Take an estimate; ignored if it was not aligned with the map."""
        if CUTS & set(estimate.status):
            self._begin()
            return
        if not estimate.is_aligned:
            return
        if self._stamps and estimate.stamp <= self._stamps[-1]:
            self._begin()
        self._stamps.append(int(estimate.stamp))
        self._turns.append(rotations.from_matrix(estimate.T_map_lidar[:3, :3]))
        if self._stamps[-1] - self._stamps[0] >= _PART_NS or len(self._stamps) > _MOST_POSES:
            self._end_part()

    def _end_part(self) -> None:
        """Add a part, and judge all of them."""
        stamps = np.array(self._stamps, dtype=np.int64)
        turns = np.stack(self._turns)
        samples = np.concatenate(self._samples) if self._samples else np.empty(0, IMU_SAMPLE)
        last_stamp, last_turn = self._stamps[-1], self._turns[-1]
        later = samples[samples["stamp"] > last_stamp - _PART_NS // 100]
        self._begin()
        self._stamps.append(last_stamp)
        self._turns.append(last_turn)
        self.imu(later)
        samples = samples[np.argsort(samples["stamp"], kind="stable")]
        rates = samples["angular_velocity"].astype(np.float64)
        if not np.isfinite(rates).all():
            return
        if gyro.excitation(samples["stamp"], rates).max(initial=0.0) < _PART_EXCITATION:
            return
        found = gyro.turns_between(stamps, turns, samples, self._model)
        if len(found.residual) >= _FEWEST_TURNS:
            self._parts = [*self._parts[1 - _MOST_PARTS :], gyro.information(found)]
            self._judge()

    def _judge(self) -> None:
        """Set the finding of all parts, if they agree."""
        count = len(self._parts)
        if count < _FEWEST_PARTS:
            return
        prior = np.diag(_PRIOR_SD**-2.0)
        normal = np.sum([part[0] for part in self._parts], axis=0) + prior
        right = np.sum([part[1] for part in self._parts], axis=0)
        change = np.asarray(np.linalg.solve(normal, right), np.float64)
        without = np.stack([np.linalg.solve(normal - a, right - b) for a, b in self._parts])
        away = without - without.mean(axis=0)
        jackknife = (away**2).sum(axis=0) * (count - 1) / count
        self._change = change
        self._sd = np.sqrt(np.maximum(jackknife, np.diag(np.linalg.inv(normal))))
        self.finding = "; ".join(text for text in (self._rotation(), self._offset()) if text)

    def _rotation(self) -> str:
        """Return the finding about the rotation."""
        assert self._change is not None
        vector, sd = self._change[gyro.ROTATION], self._sd[gyro.ROTATION]
        clear = (sd < _KNOWN) & (np.abs(vector) > _CERTAIN * sd)
        size = float(np.linalg.norm(np.where(clear, vector, 0.0)))
        if size < _WORTH_SAYING:
            return ""
        axes = ", ".join(
            f"{np.degrees(value):+.1f} about {axis}"
            for value, axis, known in zip(vector, "xyz", clear, strict=True)
            if known
        )
        return f"extrinsic rotation looks {np.degrees(size):.1f} degrees off ({axes})"

    def _offset(self) -> str:
        """Return the finding about the time offset."""
        assert self._change is not None
        value, sd = float(self._change[gyro.OFFSET]), float(self._sd[gyro.OFFSET])
        if sd > _KNOWN_S or abs(value) < max(_WORTH_SAYING_S, _CERTAIN * sd):
            return ""
        return f"stamps of IMU samples look {1e3 * abs(value):.1f} ms too " + (
            "late" if value > 0 else "early"
        )
