"""Tables of SMGDiff (Yang et al. 2024)."""

from reports.claims import Absent, Claim, Column, Row, Source, Table, below, chain

_TRAIN = "python experiments/smgdiff.py train --data data/dribble.npz --out {run}"
_DATA = (
    "Paper: Soccer-X, recorded players; here: Bandai-Namco's locomotion with a "
    "synthetic ball (dribble.py)."
)


def _source(table: str, stages: str = "") -> Source:
    return Source(
        run="smgdiff",
        file=f"evaluation/{table}/metrics.json",
        commands=(
            _TRAIN + stages,
            f"python experiments/smgdiff.py evaluate --run {{run}} --tables {table}",
        ),
    )


SCHEDULES = _source("schedules")
PATHS = _source("paths")
STEPS = _source("steps", " --stages motion_2 motion_4 motion_8 motion_16 motion_32")

FID = Column(
    name="FID", here="FID", better="lower", judged=True, note="of another recognizer"
)
SLIDE = Column(
    name="Ft. Slid.",
    here="foot slide m/s",
    better="lower",
    note="m/s of feet on the ground; the paper's is a length",
)
ACCELERATION = Column(
    name="Accel.",
    here="acceleration m/s2",
    better="lower",
    note="m/s^2; the paper's values fit a ratio of speeds",
)
DIVERSITY = Column(name="Div.", here="diversity m2", better="higher", note="m^2")
_BASELINE = "its network with phases or a codebook is not part of this"

TABLE_1 = Table(
    paper="SMGDiff",
    number="1",
    title="against other controllers, along the path that was walked",
    source=SCHEDULES,
    columns=(
        FID,
        SLIDE,
        ACCELERATION,
        DIVERSITY,
        Column(
            name="Traj. Err.",
            here="trajectory error deg",
            better="lower",
            note="degrees",
        ),
        Column(
            name="Orient. Err.",
            here="orientation error deg",
            better="lower",
            note="degrees",
        ),
        Column(
            name="Skill Acc.",
            here="skill accuracy",
            better="higher",
            judged=True,
            scale=100.0,
            note="%",
        ),
    ),
    rows=tuple(
        Row(name=name, here=None, paper=paper, reason=_BASELINE)
        for name, paper in {
            "LMP": (0.3541, 1.0678, 1.6070, 0.3980, 4.1156, 6.4932, 73.3),
            "MANN-DP": (0.3593, 1.3507, 1.5652, 0.4753, 4.0690, 5.2985, 69.1),
            "CM": (0.2494, 1.6498, 1.1752, 0.3520, 3.1034, 5.0663, 52.9),
        }.items()
    )
    + (
        Row(
            name="Ours",
            here="end 2",
            paper=(0.1813, 0.8543, 1.1999, 0.6177, 2.4132, 4.9393, 93.3),
        ),
        Row(
            name="Held-out clips (not in the paper)",
            here="real (held-out clips)",
            paper=(None,) * 7,
        ),
    ),
    note=_DATA + " All claims of this table are about baselines that are not run here.",
)

TABLE_2 = Table(
    paper="SMGDiff",
    number="2",
    title="trajectory generation (TGM) and contact guidance (CGM)",
    source=PATHS,
    columns=(FID, SLIDE, ACCELERATION, DIVERSITY),
    rows=(
        Row(
            name="Ours w/o TGM",
            here="straight paths, guidance end 2",
            paper=(0.3646, 1.0031, 1.1973, 2.4331),
        ),
        Row(
            name="Ours w/o CGM",
            here="generator, T = 1, guidance none",
            paper=(0.3704, 1.0046, 1.1957, 2.6908),
        ),
        Row(
            name="Ours",
            here="generator, T = 1, guidance end 2",
            paper=(0.3580, 1.0049, 1.2012, 2.6925),
        ),
    ),
    claims=(
        Claim(
            words="generated paths lower FID",
            column="FID",
            pairs=(("Ours", "Ours w/o TGM"),),
            where="section 5.2, table 2",
        ),
        Claim(
            words="generated paths raise diversity",
            column="Div.",
            pairs=(("Ours w/o TGM", "Ours"),),
            where="section 5.2, table 2",
        ),
        Claim(
            words="contact guidance lowers FID",
            column="FID",
            pairs=(("Ours", "Ours w/o CGM"),),
            where="section 5.2, table 2",
        ),
        Claim(
            words="contact guidance makes feet slide slightly more",
            column="Ft. Slid.",
            pairs=(("Ours w/o CGM", "Ours"),),
            where="section 5.2, table 2",
        ),
        Claim(
            words="contact guidance makes motion slightly less smooth",
            column="Accel.",
            pairs=(("Ours w/o CGM", "Ours"),),
            where="section 5.2, table 2",
        ),
    ),
    note=_DATA,
)

_STEPS = ("2", "4", "8", "16", "32")
TABLE_3 = Table(
    paper="SMGDiff",
    number="3",
    title="denoising steps, without guidance",
    source=STEPS,
    columns=(
        Column(
            name="Inf. Time (ms)",
            here="ms a plan",
            better="lower",
            kind="time",
            note="at batch 1, this machine; the middle half of the calls",
        ),
        FID,
        SLIDE,
        ACCELERATION,
    ),
    rows=tuple(
        Row(name=f"{steps} steps", here=f"{steps} steps", paper=paper)
        for steps, paper in zip(
            _STEPS,
            (
                (3.0, 0.3954, 1.2438, 1.1882),
                (6.0, 0.3896, 1.1471, 1.1751),
                (12.0, 0.3704, 1.0046, 1.1957),
                (25.0, 0.3663, 1.0434, 1.1953),
                (52.0, 0.3379, 1.0708, 1.2007),
            ),
            strict=True,
        )
    ),
    claims=(
        Claim(
            words="more steps take longer",
            column="Inf. Time (ms)",
            pairs=chain(*(f"{steps} steps" for steps in _STEPS)),
            where="section 5.3, table 3",
        ),
        Claim(
            words="more steps lower FID, as far as 32",
            column="FID",
            pairs=chain(*(f"{steps} steps" for steps in reversed(_STEPS))),
            where="table 3",
        ),
        Claim(
            words="feet slide least with 8 steps",
            column="Ft. Slid.",
            pairs=below(
                "8 steps", tuple(f"{steps} steps" for steps in _STEPS if steps != "8")
            ),
            where="section 5.3, table 3",
        ),
    ),
    note=_DATA,
)

_OTHERS = ("Start 1", "End 1", "Start 2", "Start 1, End 1")
TABLE_4 = Table(
    paper="SMGDiff",
    number="4",
    title="where in the chain guidance acts",
    source=SCHEDULES,
    columns=(
        FID,
        SLIDE,
        ACCELERATION,
        Column(
            name="missed",
            here="missed part",
            better="lower",
            note="part of the touches that no foot made; the paper only shows some",
        ),
    ),
    rows=tuple(
        Row(name=name, here=here, paper=(*paper, None))
        for name, here, paper in (
            ("None (table 3, 8 steps)", "none", (0.3704, 1.0046, 1.1957)),
            ("Start 1", "start 1", (0.3642, 1.0035, 1.1939)),
            ("End 1", "end 1", (0.3629, 1.0049, 1.2029)),
            ("Start 2", "start 2", (0.3672, 1.0046, 1.1931)),
            ("End 2", "end 2", (0.3580, 1.0049, 1.2012)),
            ("Start 1, End 1", "start 1, end 1", (0.3661, 1.0041, 1.1984)),
        )
    ),
    claims=(
        Claim(
            words="guidance in the last two steps has the lowest FID of all schedules",
            column="FID",
            pairs=below("End 2", _OTHERS),
            where="section 5.3, table 4",
        ),
        Claim(
            words="every schedule has a lower FID than no guidance",
            column="FID",
            pairs=tuple(
                (name, "None (table 3, 8 steps)") for name in (*_OTHERS, "End 2")
            ),
            where="tables 3 and 4",
        ),
        Claim(
            words="guidance prevents missed touches",
            column="missed",
            pairs=(("End 2", "None (table 3, 8 steps)"),),
            where="section 5.2, figure 6",
        ),
    ),
    note=_DATA,
)

TABLES = (TABLE_1, TABLE_2, TABLE_3, TABLE_4)
ABSENT = (
    Absent(
        paper="SMGDiff",
        what="table 1: best of four methods in all metrics but acceleration",
        reason="LMP, MANN-DP and codebook matching are not part of jaxmotion; Soccer-X "
        "is not published",
    ),
)
