// What held keys, sticks and the mouse ask of a character; as `jaxmotion.control.steering`
// says for the live page, which has the same numbers.

export const RUN = 2.0, TURN = 150 * Math.PI / 180;
export const ARRIVE = 0.7, NEAR = 0.2;
const FAR = 0.45;
const HEADING_STEP = 8 * Math.PI / 180, SPEED_STEP = 0.15, STICK = 0.12;

export const still = () => ({ velocity: [0, 0], facing: [0, 1] });
export const speedOf = wish => Math.hypot(...wish.velocity);
const to = angle => [Math.sin(angle), Math.cos(angle)];

function go(angle, speed, facing = to(angle)) {
  return { velocity: to(angle).map(x => speed * x), facing };
}

// A stick's (right, ahead): its angle for who looks along `azimuth`, and how far it is
// pushed, 0 to 1; null in its middle.
function pushed(stick, azimuth) {
  const far = stick ? Math.hypot(...stick) : 0;
  if (far < STICK) return null;
  return { angle: azimuth - Math.atan2(...stick), part: Math.min(far, 1) };
}

// The wish of a tick; `last` is that of the tick before.
export function wanted(inputs, last, { position, speed, seconds }) {
  const held = name => inputs.held.includes(name);
  const ahead = held("forward") - held("back"), aside = held("right") - held("left");
  const fast = speed * (held("run") ? RUN : 1), { azimuth } = inputs;
  const face = pushed(inputs.face, azimuth), facing = face ? to(face.angle) : undefined;
  if (ahead || aside) return go(azimuth - Math.atan2(aside, ahead), fast, facing);
  const stick = pushed(inputs.stick, azimuth);
  if (stick) return go(stick.angle, stick.part * fast, facing);
  if (facing) return { velocity: [0, 0], facing };
  const turn = held("turn_left") - held("turn_right");
  if (turn) {
    const angle = Math.atan2(...last.facing) + turn * TURN * seconds;
    return { velocity: [0, 0], facing: to(angle) };
  }
  if (inputs.target) {
    const [x, z] = inputs.target.map((p, i) => p - position[i]);
    const distance = Math.hypot(x, z);
    if (distance > (speedOf(last) ? NEAR : FAR))
      return go(Math.atan2(x, z), Math.min(fast, distance / ARRIVE));
  }
  return { velocity: [0, 0], facing: last.facing };
}

// What to tell the character: every change of it costs a plan, so small ones wait.
export function settled(told, wish, steady) {
  const stops = Boolean(speedOf(told)) !== Boolean(speedOf(wish));
  const along = (a, b) => a[0] * b[0] + a[1] * b[1], step = Math.cos(HEADING_STEP);
  const far = along(told.facing, wish.facing) < step
    // Another way to go with the same facing, as of a second stick, counts as well.
    || along(told.velocity, wish.velocity) < step * speedOf(told) * speedOf(wish)
    || Math.abs(speedOf(told) - speedOf(wish)) > SPEED_STEP;
  return stops || far || steady ? wish : told;
}

export function same(a, b) {
  return [0, 1].every(i => a.velocity[i] === b.velocity[i] && a.facing[i] === b.facing[i]);
}
