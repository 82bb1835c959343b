"""Tables of EMDM's appendix D, and the tables that cannot be run."""

from reports import emdm, emdm_ablation
from reports.claims import Absent, Claim, Column, Row, Table
from reports.emdm_ablation import COLUMNS, NOTE

OURS = emdm_ablation.TABLE_4.row("10 steps").paper
REAL = emdm_ablation.REAL.paper

TABLE_D7 = Table(
    paper="EMDM",
    number="D7",
    title="ten steps of DDIM",
    source=emdm.ACTION,
    columns=(*COLUMNS, emdm.TIME),
    rows=(
        Row(name="Real", here="real (training clips)", paper=(*REAL, None)),
        Row(
            name="MDM, all (table 1)",
            here="ddpm_1000",
            paper=((0.508, 0.034), (9.373, 0.094), (2.880, 0.088), (62.505, 0.071)),
        ),
        Row(
            name="MDM, 10 of DDIM",
            here="ddim_10",
            paper=((33.232, 0.308), (3.440, 0.060), (2.325, 0.023), (0.673, 0.001)),
        ),
        Row(name="EMDM (Ours)", here="emdm", paper=(*OURS, (0.280, 0.002))),
    ),
    claims=(
        Claim(
            words="EMDM has a lower FID than ten steps of DDIM",
            column="FID",
            pairs=(("EMDM (Ours)", "MDM, 10 of DDIM"),),
            where="section D.1, table D7",
        ),
        Claim(
            words="ten steps of DDIM raise FID over all steps of the same weights",
            column="FID",
            pairs=(("MDM, all (table 1)", "MDM, 10 of DDIM"),),
            where="section D.1, tables 1 and D7",
        ),
        Claim(
            words="EMDM's diversity is nearer to the data's than that of DDIM",
            column="Diversity",
            pairs=(("EMDM (Ours)", "MDM, 10 of DDIM"),),
            where="table D7",
            toward="Real",
        ),
        Claim(
            words="EMDM takes less time than ten steps of DDIM",
            column="ms a frame",
            pairs=(("EMDM (Ours)", "MDM, 10 of DDIM"),),
            where="table D7",
        ),
    ),
    note=NOTE + " Both are of one size here.",
)

TABLE_D8 = Table(
    paper="EMDM",
    number="D8",
    title="naive denoising-diffusion GAN",
    source=emdm.ACTION,
    columns=COLUMNS,
    rows=(
        emdm_ablation.REAL,
        Row(
            name="Naive DDGAN",
            here="naive",
            paper=((31.085, 0.256), (5.060, 0.059), (3.155, 0.092)),
        ),
        Row(name="EMDM (Ours)", here="emdm", paper=OURS),
    ),
    claims=(
        Claim(
            words="EMDM has a lower FID than the naive GAN",
            column="FID",
            pairs=(("EMDM (Ours)", "Naive DDGAN"),),
            where="section D.2, table D8",
        ),
        Claim(
            words="EMDM's diversity is nearer to the data's",
            column="Diversity",
            pairs=(("EMDM (Ours)", "Naive DDGAN"),),
            where="table D8",
            toward="Real",
        ),
    ),
    note=NOTE,
)

TABLE_D10 = Table(
    paper="EMDM",
    number="D10",
    title="physical plausibility",
    source=emdm.ACTION,
    columns=(
        Column(
            name="Penetration",
            here="penetration mm",
            better="lower",
            note="mm, of joints; the paper gives no unit",
        ),
        Column(
            name="Skate",
            here="skate mm",
            better="lower",
            note="mm a frame; the paper gives no unit",
        ),
    ),
    rows=(
        Row(name="EMDM", here="emdm", paper=(0.094, 1.083)),
        Row(name="MDM", here="ddpm_1000", paper=(0.064, 0.878)),
        Row(
            name="Held-out clips (not in the paper)",
            here="real (held-out clips)",
            paper=(None, None),
        ),
    ),
    claims=(
        Claim(
            words="MDM penetrates the ground less than EMDM",
            column="Penetration",
            pairs=(("MDM", "EMDM"),),
            where="table D10",
        ),
        Claim(
            words="MDM's feet skate less than EMDM's",
            column="Skate",
            pairs=(("MDM", "EMDM"),),
            where="table D10",
        ),
    ),
    note=NOTE,
)

TABLES = (
    emdm.TABLE_1,
    emdm.TABLE_3,
    emdm_ablation.TABLE_4,
    emdm_ablation.TABLE_4_SWEEP,
    emdm_ablation.TABLE_5,
    emdm.TABLE_B6,
    TABLE_D7,
    TABLE_D8,
    TABLE_D10,
)
ABSENT = (
    Absent(
        paper="EMDM",
        what="tables 1, 3, B6, D7 and D10: the rows of other methods (TEMOS, T2M, "
        "MotionDiffuse, MLD, T2M-GPT, MoFusion, M2DM, ReMoDiffuse, ACTOR, INR, "
        "VPoser-t)",
        reason="they are not part of jaxmotion; HumanML3D, HumanAct12 and AMASS are "
        "not at hand",
    ),
    Absent(
        paper="EMDM",
        what="table 2: KIT",
        reason="the data are not at hand, and Bandai-Namco's captions stand in for "
        "table 1 already",
    ),
    Absent(
        paper="EMDM",
        what="tables 4, 5, D7 and D8: R-precision and MM Dist",
        reason="their rows are trained from actions here, which have neither",
    ),
    Absent(
        paper="EMDM",
        what="table D9: discriminator without condition",
        reason="no row of emdm.py changes this alone; `naive` (table D8) also takes "
        "the geometric losses away",
    ),
)
