"""Humanoid robots of our own, as MJCF and URDF."""

# Hinges of a limb from the trunk: name, axis and range; then how far to the next.
_LEG = (
    ("hip_yaw", "0 0 1", (-1.0, 1.0), "0 0 -.06"),
    ("hip_roll", "1 0 0", (-0.8, 0.8), "0 0 -.02"),
    ("hip_pitch", "0 1 0", (-1.8, 1.2), "0 0 -.36"),
    ("knee", "0 1 0", (-0.1, 2.4), "0 0 -.38"),
    ("ankle_pitch", "0 1 0", (-1.0, 0.7), "0 0 -.02"),
    ("ankle_roll", "1 0 0", (-0.4, 0.4), None),
)
_ARM = (
    ("shoulder_pitch", "0 1 0", (-3.0, 1.5), "0 0 0"),
    ("shoulder_roll", "1 0 0", (-2.0, 2.0), "0 0 -.03"),
    ("shoulder_yaw", "0 0 1", (-1.5, 1.5), "0 0 -.22"),
    ("elbow", "0 1 0", (-2.4, 0.0), None),
)


def _limb(side, hinges, start, shapes, tight):
    """Nested bodies; the far end first."""
    found = ""
    mirrored = -1 if side == "right" else 1
    for number in reversed(range(len(hinges))):
        name, axis, (low, high), _ = hinges[number]
        low, high = low * tight, high * tight
        if mirrored < 0 and axis != "0 1 0":
            low, high = -high, -low
        place = start if number == 0 else hinges[number - 1][3]
        shape = shapes.get(
            name, '<geom type="sphere" size=".03" contype="0" conaffinity="0"/>'
        )
        found = (
            f'<body name="{side}_{name}_link" pos="{place}">'
            f'<joint name="{side}_{name}_joint" axis="{axis}" range="{low} {high}"/>'
            f"{shape}{found}</body>"
        )
    return found


def mjcf(
    *,
    free=True,
    legs=True,
    facing=0.0,
    tight=1.0,
    extra="",
    servos="",
    foot='<geom name="{}_foot" type="box" pos=".05 0 -.04" size=".11 .04 .02"/>',
):
    """A humanoid of 1.3 m that stands facing +x, turned by `facing` degrees.

    Args:
      tight: What is left of the joints' ranges.
      extra: Elements of the world beside it.
      servos: Actuators.
      foot: Geometry of a foot.
    """
    bone = '<geom type="capsule" size=".04" fromto="0 0 0 0 0 {}"/>'
    limbs = ""
    for side, y in (("left", 0.1), ("right", -0.1)):
        shapes = {"hip_pitch": bone.format(-0.3), "knee": bone.format(-0.3)}
        shapes["ankle_roll"] = foot.format(side)
        if legs:
            limbs += _limb(side, _LEG, f"0 {y} -.05", shapes, tight)
    arms = "".join(
        _limb(
            side,
            _ARM,
            f"0 {y} .3",
            {"shoulder_yaw": bone.format(-0.2), "elbow": bone.format(-0.25)},
            tight,
        )
        for side, y in (("left", 0.18), ("right", -0.18))
    )
    joint = '<freejoint name="base"/>' if free else ""
    return f"""<mujoco model="ours">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>{extra}
    <body name="pelvis" pos="0 0 .96" euler="0 0 {facing * 3.14159265358979 / 180}">
      {joint}<geom type="sphere" size=".08"/>{limbs}
      <body name="torso_link" pos="0 0 .08">
        <joint name="waist_yaw_joint" axis="0 0 1" range="-1 1"/>
        <joint name="waist_pitch_joint" axis="0 1 0" range="-.4 .8"/>
        <geom type="capsule" size=".09" fromto="0 0 0 0 0 .3"/>{arms}
      </body>
    </body>
  </worldbody>
  <actuator>{servos}</actuator>
</mujoco>"""


def quadruped():
    legs = "".join(
        f'<body name="{name}_hip" pos="{x} {y} 0"><joint axis="1 0 0"/>'
        '<geom size=".03"/>'
        f'<body name="{name}_thigh" pos="0 0 -.05"><joint axis="0 1 0"/>'
        '<geom size=".03"/>'
        f'<body name="{name}_calf" pos="0 0 -.2"><joint axis="0 1 0"/>'
        f'<geom size=".03"/><body name="{name}_foot" pos="0 0 -.2">'
        '<geom size=".02"/></body></body></body></body>'
        for name, x, y in (
            *(("FL", 0.2, 0.1), ("FR", 0.2, -0.1)),
            *(("RL", -0.2, 0.1), ("RR", -0.2, -0.1)),
        )
    )
    return f"""<mujoco><worldbody><body name="trunk" pos="0 0 .5"><freejoint/>
    <geom type="box" size=".25 .1 .05"/>{legs}</body></worldbody></mujoco>"""


def urdf(*, velocity=6.0):
    """The same without waist, as ROS has it: no free joint, and limits of speed."""
    links, joints = ["pelvis"], []

    def link(name):
        size = "0.22 0.08 0.04" if "ankle_roll" in name else "0.05 0.05 0.05"
        place = "0.05 0 -0.04" if "ankle_roll" in name else "0 0 0"
        return (
            f'<link name="{name}"><inertial><mass value="1"/><inertia ixx=".01" '
            'iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial><collision>'
            f'<origin xyz="{place}"/><geometry><box size="{size}"/></geometry>'
            "</collision></link>"
        )

    for side, sign in (("left", 1), ("right", -1)):
        for hinges, start in (
            (_LEG, f"0 {sign * 0.1} -.05"),
            (_ARM, f"0 {sign * 0.18} .4"),
        ):
            above, place = "pelvis", start
            for name, axis, (low, high), after in hinges:
                own = f"{side}_{name}_link"
                joints.append(
                    f'<joint name="{side}_{name}_joint" type="revolute"><parent '
                    f'link="{above}"/><child link="{own}"/><origin xyz="{place}"/>'
                    f'<axis xyz="{axis}"/><limit lower="{low}" upper="{high}" '
                    f'effort="50" velocity="{velocity}"/></joint>'
                )
                links.append(own)
                above, place = own, after
    return f'<robot name="ours">{"".join(map(link, links))}{"".join(joints)}</robot>'
