// What waypoints ask for: `jaxmotion.control.waypoints` and `goals.pursue` of the live
// page, which has the same numbers.

import { ARRIVE, NEAR, speedOf } from "./steer.js";

export const MOST = 32;
const NEAREST = 0.25, REACH = 1, LATER = 0.01, PARTS = 40, THERE = 0.05, LAG = 0.25;
const away = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);

// The velocity of who moved so in a tick, m/s; hips sway, so over .2 s.
export function averaged(velocity, moved, fps) {
  const keep = 0.5 ** (1 / (0.1 * fps));
  return velocity.map((v, i) => keep * v + (1 - keep) * moved[i]);
}

// The route along waypoints, for who is at a position; one that grows goes on.
export function routed(route, waypoints, position) {
  if (!waypoints.length) return null;
  const old = route ? route.points.slice(1) : [];
  const grows = route && old.every((p, i) => waypoints[i] && !away(p, waypoints[i]));
  const points = [grows ? route.points[0] : position, ...waypoints];
  return { points, way: grows ? route.way : 0 };
}

// The wish of a tick and the route from there; `last` is the wish of the tick before.
export function along({ points, way }, last, { position, velocity, speed, ahead }) {
  const marks = [0], end = points[points.length - 1];
  for (let i = 1; i < points.length; i++) marks.push(marks[i - 1] + away(points[i], points[i - 1]));
  const length = marks[marks.length - 1];
  const at = far => {
    const i = marks.findIndex(mark => mark > far);
    if (i < 0) return end;
    const part = (far - marks[i - 1]) / (marks[i] - marks[i - 1]);
    return points[i].map((x, k) => points[i - 1][k] + part * (x - points[i - 1][k]));
  };
  const here = position.map((x, i) => x + LAG * velocity[i]);
  const ways = [...Array(PARTS + 1).keys()].map(i => way + i * REACH / PARTS);
  const gaps = ways.map(far => away(at(far), here) + LATER * (far - way));
  way = Math.min(ways[gaps.indexOf(Math.min(...gaps))], length);
  const left = length - way + (way >= length ? away(end, here) : 0);
  const ends = length - way < NEAR && away(end, position) < NEAR && !speedOf(last);
  const goal = at(way + Math.max(ahead * speed, NEAREST)), far = away(goal, here);
  const route = { points, way };
  if (left < THERE || ends) return [{ velocity: [0, 0], facing: last.facing }, route];
  const facing = far < 1e-6 ? last.facing : goal.map((x, i) => (x - here[i]) / far);
  const fast = Math.min(speed, left / ARRIVE);
  return [{ velocity: facing.map(x => fast * x), facing }, route];
}
