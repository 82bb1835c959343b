"""The columns of all tables, each declared once: id, title, unit, direction.

Rows, their files and the papers' tables are joined by these ids. A metric that is not
declared here stands in tables under its own name.
"""

import dataclasses
import math
from typing import Literal

Direction = Literal["lower", "higher", "real", ""]
ARROWS: dict[Direction, str] = {"lower": "↓", "higher": "↑", "real": "→", "": ""}
Kind = Literal["mean", "time", "count"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Column:
    """One metric.

    Attributes:
      unit: "" for what has none.
      better: Where good values lie; "real" is near those of recorded motion, ""
        nowhere.
      kind: "mean" has an interval of 95 %, or none; "time" has that of the median, the
        middle half of the calls, or none; "count" is a number of the samples.
      evaluated: It is an evaluator's: values of two evaluators do not compare.
      bounds: Bounds of what the mean can be, in the unit.
    """

    id: str
    title: str
    unit: str = ""
    better: Direction = "lower"
    kind: Kind = "mean"
    evaluated: bool = False
    bounds: tuple[float, float] = (-math.inf, math.inf)

    @property
    def header(self) -> str:
        """Title and unit."""
        return f"{self.title}, {self.unit}" if self.unit else self.title


_SHARE, _PERCENT = (0.0, 1.0), (0.0, 100.0)


def _evaluated(id: str, title: str, better: Direction = "lower", **more) -> Column:
    return Column(id=id, title=title, better=better, evaluated=True, **more)


def _share(id: str, title: str, better: Direction = "lower") -> Column:
    return Column(id=id, title=title, better=better, bounds=_SHARE)


COLUMNS: dict[str, Column] = {
    column.id: column
    for column in (
        # Distances and spreads of features.
        _evaluated("fid", "FID"),
        _evaluated("fid_unbiased", "FID, unbiased"),
        _evaluated("fid_held_out", "FID to held-out clips"),
        _evaluated("fid_added", "FID more than without the fault", "higher"),
        _evaluated("fid_uc", "FID under control"),
        _evaluated("accuracy", "accuracy", "higher", bounds=_SHARE),
        _evaluated("style_accuracy", "style accuracy", "higher", unit="%"),
        _evaluated("skill_accuracy", "skill accuracy", "higher", bounds=_SHARE),
        _evaluated("r_precision_1", "R-precision 1", "higher", bounds=_SHARE),
        _evaluated("r_precision_2", "R-precision 2", "higher", bounds=_SHARE),
        _evaluated("r_precision_3", "R-precision 3", "higher", bounds=_SHARE),
        _evaluated(
            "r_precision_3_unseen",
            "R-precision 3, unseen pairs",
            "higher",
            bounds=_SHARE,
        ),
        _evaluated("mm_dist", "MM-Dist"),
        _evaluated("diversity", "diversity of features", "real"),
        _evaluated("multimodality", "multimodality", "higher"),
        Column(id="deviation", title="deviation of poses", unit="cm", better="real"),
        Column(id="nearest", title="to a training clip", unit="cm", better="real"),
        _share("copied", "copies of training motions"),
        Column(
            id="kept", title="deviation of samples over what is open", better="real"
        ),
        _share("told_apart", "accuracy of a classifier of samples and data"),
        Column(id="discriminator", title="loss of the discriminator", better=""),
        Column(id="prediction_error", title="error of features, deviations"),
        Column(id="over_latents", title="deviation over latents", better=""),
        Column(id="frame_error", title="error of the mean frame", unit="changes"),
        Column(
            id="frame_over_latents",
            title="deviation over latents",
            unit="changes",
            better="",
        ),
        Column(id="spread", title="deviation of poses over the data's", better="real"),
        Column(id="div", title="diversity of poses", better="real"),
        Column(id="pose_variance", title="diversity", unit="m²", better="higher"),
        # Following commands.
        Column(id="trajectory_error", title="trajectory error", unit="°"),
        Column(id="orientation_error", title="orientation error", unit="°"),
        Column(id="te_promised", title="path error, promised"),
        Column(id="te_realized", title="path error, realized"),
        Column(id="speed", title="speed", unit="m/s", better=""),
        Column(id="speed_error", title="speed error", unit="%"),
        Column(id="path_error", title="path error", unit="cm"),
        Column(id="path_error_max", title="largest path error", unit="cm"),
        Column(id="path_lead", title="ahead, as it should face", unit="cm", better=""),
        Column(id="facing_error", title="still to turn", unit="°"),
        Column(id="creep", title="creep in 10 s", unit="cm"),
        Column(id="stop_time", title="time to stop", unit="s"),
        Column(id="start_time", title="time to start", unit="s"),
        Column(id="half_turn_time", title="time to turn half", unit="s"),
        Column(id="turn_time", title="time to turn", unit="s"),
        _share("disobeyed", "commands not obeyed"),
        _evaluated("success", "success", "higher", unit="%", bounds=_PERCENT),
        _evaluated("transition_time", "transition", unit="s"),
        _evaluated("transition_frames", "transition", unit="frames"),
        # Feet and smoothness.
        Column(id="foot_slide", title="foot slide", unit="m/s"),
        _share("skate_ratio", "skate ratio"),
        _share("ffr_mann", "skating frames (MANN)"),
        _share("ffr_gmd", "skating frames (GMD)"),
        _share("ffr_mann_uc", "skating frames (MANN) under control"),
        _share("ffr_gmd_uc", "skating frames (GMD) under control"),
        Column(id="penetration", title="penetration", unit="mm"),
        Column(id="floating", title="floating", unit="mm"),
        Column(id="skate", title="skate", unit="mm"),
        Column(id="skate_recorded", title="recorded", unit="mm", better=""),
        Column(id="crossings", title="legs cross", unit="per minute", better="real"),
        Column(id="strides", title="strides", unit="per second", better="real"),
        Column(id="toe_sink", title="lowest toe below rest", unit="cm"),
        Column(id="toe_depth", title="mean toe below rest", unit="cm"),
        Column(id="toe_swing", title="swinging toe", unit="cm", better=""),
        Column(id="toe_swing_low", title="its 10th percentile", unit="cm", better=""),
        Column(id="acceleration", title="acceleration", unit="m/s²"),
        Column(id="jerk", title="jerk", unit="m/s³"),
        # A ball.
        Column(id="touches", title="touches", unit="per minute", better=""),
        Column(id="missed", title="missed", unit="per minute"),
        _share("missed_part", "missed part"),
        Column(id="ball_away", title="ball away", unit="m", better="real"),
        Column(id="touch_distance", title="touch distance", unit="cm"),
        Column(id="ball_in_ground", title="ball in ground", unit="mm"),
        Column(id="foot_in_ball", title="foot in ball", unit="mm"),
        Column(id="free_acceleration", title="free acceleration", unit="m/s²"),
        # As CAMDM's release computes them.
        _evaluated("fid_camdm_release", "FID (release)"),
        Column(id="slide_camdm_release", title="foot slide (release)"),
        Column(id="coherence_camdm_release", title="acceleration (release)"),
        Column(
            id="trajectory_camdm_release", title="trajectory error (release)", unit="°"
        ),
        Column(
            id="orientation_camdm_release",
            title="orientation error (release)",
            unit="°",
        ),
        # A training.
        Column(id="held_out_25", title="held-out loss, 25 % of the updates"),
        Column(id="held_out_50", title="50 %"),
        Column(id="held_out_75", title="75 %"),
        Column(id="held_out_100", title="all updates"),
        Column(id="update_time", title="an update", unit="processor ms"),
        Column(id="updates_needed", title="updates to the worst row's last loss"),
        Column(id="seconds_needed", title="to that loss", unit="processor s"),
        # Health.
        Column(id="diverged", title="diverged", kind="count"),
        Column(id="diverged_uc", title="diverged under control", kind="count"),
        Column(id="diverged_unbounded", title="diverged, unbounded", kind="count"),
        Column(id="frozen", title="frozen", kind="count"),
        Column(id="minutes", title="character-minutes", better="", kind="count"),
        Column(id="windows", title="windows", better="", kind="count"),
        # Times.
        Column(id="p50", title="p50", unit="ms", kind="time"),
        Column(id="p95", title="p95", unit="ms", kind="time"),
        Column(id="plan_time", title="a plan", unit="ms", kind="time"),
        Column(id="frame_time", title="a frame", unit="ms", kind="time"),
        Column(
            id="fps",
            title="frames per second",
            better="higher",
            kind="time",
        ),
        Column(id="network_calls", title="network calls", better=""),
    )
}


def header(name: str) -> str:
    """What stands above a column: title and unit, or its name if it is not declared."""
    return COLUMNS[name].header if name in COLUMNS else name
