// Keys, mouse, thumbs and gamepads: what somebody asks for now, the same for all of them.

import { clamp } from "./camera.js";
import { MOST } from "./waypoints.js";

export const KEYS = {
  KeyW: "forward", ArrowUp: "forward", KeyS: "back", ArrowDown: "back",
  KeyA: "left", ArrowLeft: "left", KeyD: "right", ArrowRight: "right",
  ShiftLeft: "run", ShiftRight: "run", KeyQ: "turn_left", KeyE: "turn_right",
};
const MOVES = ["forward", "back", "left", "right"], REACH = 56, TAP = 10;

export class Input {
  // view: the canvas; camera; stick: the element that shows the thumb's stick;
  // on: `change()` when something else is asked for, `key(code)` for other keys,
  // `news()` when a picture is to be drawn, `fail(text)`; `here()` is where the first
  // character is.
  constructor(view, camera, stick, on) {
    Object.assign(this, { view, camera, stickElement: stick, on });
    this.pressed = new Set(); this.pads = new Set(); this.forget();
    this.thumb = null; this.pad = {}; this.fingers = new Map(); this.buttons = [];
    window.addEventListener("keydown", e => this.keydown(e));
    window.addEventListener("keyup", e => {
      if (KEYS[e.code]) { this.pressed.delete(KEYS[e.code]); on.change(); }
    });
    window.addEventListener("blur", () => { this.pressed.clear(); on.change(); });
    view.addEventListener("contextmenu", e => e.preventDefault());
    view.addEventListener("pointerdown", e => this.down(e));
    view.addEventListener("pointermove", e => this.move(e));
    for (const name of ["pointerup", "pointercancel"])
      view.addEventListener(name, e => this.up(e));
    view.addEventListener("wheel", e => {
      e.preventDefault(); camera.zoom(Math.exp(e.deltaY / 700)); on.news();
    }, { passive: false });
  }

  // No target and no waypoints; these are a path from where the first one was set.
  forget() { this.target = null; this.path = []; this.from = null; }

  get held() { return new Set([...this.pressed, ...this.pads]); }

  // What is sent: sticks are (right, ahead), at most 1 long.
  asked() {
    const held = [...this.held], moves = MOVES.some(x => held.includes(x));
    const stick = this.thumb || this.pad.stick || null, face = this.pad.face || null;
    return {
      // Who walks turns with the view; who stands turns on the spot.
      held: held.filter(x => !((moves || stick) && x.startsWith("turn"))),
      azimuth: +this.camera.azimuth.toFixed(3),
      target: moves || stick || face ? null : this.target,
      ...(this.path.length && !(moves || stick || face) ? { path: this.path } : {}),
      ...(stick ? { stick } : {}), ...(face ? { face } : {}),
    };
  }

  // Turns the view with who walks and presses Q or E, or with the pad.
  turn(seconds) {
    const { held } = this, turn = held.has("turn_left") - held.has("turn_right");
    const walks = MOVES.some(x => held.has(x)) || this.thumb || this.pad.stick;
    const rate = (walks ? turn : 0) + (this.pad.orbit || 0);
    if (rate) { this.camera.azimuth += 1.7 * rate * seconds; this.on.change(); }
  }

  keydown(e) {
    if (e.ctrlKey || e.metaKey || e.altKey || e.target.tagName === "SELECT") return;
    const action = KEYS[e.code];
    if (action) {
      e.preventDefault();
      if (action !== "run") this.forget();
      if (!e.repeat) { this.pressed.add(action); this.on.change(); }
    } else if (!e.repeat) {
      if (e.code === "Space") e.preventDefault();
      this.on.key(e.code);
    }
  }

  down(e) {
    if (document.activeElement) document.activeElement.blur();
    try { this.view.setPointerCapture(e.pointerId); } catch { /* of a test, no pointer */ }
    const { clientX: x, clientY: y } = e, touch = e.pointerType === "touch";
    const low = y > 0.35 * this.view.clientHeight;
    let does = e.button === 0 && !e.altKey ? "target" : "turn";
    if (does === "target" && e.shiftKey) does = "waypoint";
    if (touch) does = x < 0.45 * this.view.clientWidth && low ? "stick" : "turn";
    this.fingers.set(e.pointerId, { does, x, y, from: [x, y], far: 0 });
    if (does === "target") this.point(x, y);
    if (does === "waypoint") this.lengthen(x, y);
    if (does === "stick") this.showStick(x, y, 0, 0);
    this.on.news();
  }

  move(e) {
    const finger = this.fingers.get(e.pointerId);
    if (!finger) return;
    const { clientX: x, clientY: y } = e, dx = x - finger.x, dy = y - finger.y;
    finger.far = Math.max(finger.far, Math.hypot(x - finger.from[0], y - finger.from[1]));
    const others = [...this.fingers.values()].filter(f => f !== finger && f.does === "turn");
    if (finger.does === "turn" && others.length) {
      const [other] = others;
      const away = f => Math.max(Math.hypot(f.x - other.x, f.y - other.y), 1);
      const before = away(finger);
      Object.assign(finger, { x, y });
      this.camera.zoom(before / away(finger));
    } else if (finger.does === "turn") {
      this.camera.turn(dx, dy); this.on.change();
    }
    Object.assign(finger, { x, y });
    if (finger.does === "target") this.point(x, y);
    if (finger.does === "stick") {
      const [dx, dy] = [x - finger.from[0], y - finger.from[1]];
      const far = Math.max(Math.hypot(dx, dy) / REACH, 1);
      this.thumb = [dx / REACH / far, -dy / REACH / far].map(v => +v.toFixed(2));
      this.showStick(...finger.from, dx / far, dy / far);
      this.forget(); this.on.change();
    }
    this.on.news();
  }

  up(e) {
    const finger = this.fingers.get(e.pointerId);
    if (!finger) return;
    this.fingers.delete(e.pointerId);
    const tapped = e.pointerType === "touch" && finger.far < TAP && e.type === "pointerup";
    if (finger.does === "stick") { this.thumb = null; this.stickElement.hidden = true; }
    if (tapped) this.point(finger.x, finger.y);
    this.on.change(); this.on.news();
  }

  showStick(x, y, dx, dy) {
    const { style, firstElementChild: knob } = this.stickElement;
    this.stickElement.hidden = false;
    style.left = `${x}px`; style.top = `${y}px`;
    knob.style.transform = `translate(${dx}px, ${dy}px)`;
  }

  onGround(x, y) {
    const found = this.camera.onGround(this.view, x, y);
    return found && found.map(v => +v.toFixed(2));
  }

  point(x, y) {
    const found = this.onGround(x, y);
    if (found) { this.forget(); this.target = found; this.on.change(); }
  }

  // One more waypoint.
  lengthen(x, y) {
    const found = this.onGround(x, y), path = this.path.slice();
    if (!found) return;
    if (path.length === MOST) { this.on.fail(`a path has at most ${MOST} waypoints`); return; }
    const from = this.from || this.on.here();
    this.forget();
    Object.assign(this, { from, path: [...path, found] });
    this.on.change();
  }

  // Reads the first gamepad of the standard mapping; call once a picture. Left stick: go,
  // as fast as it is pushed; right stick: face; right trigger: run; shoulder buttons and
  // cross: the view; A: crouch, X and B: labels, Start: reset.
  readPad() {
    const pads = navigator.getGamepads ? [...navigator.getGamepads()] : [];
    const pad = pads.find(p => p && p.connected && p.mapping === "standard");
    if (!pad) {
      const held = this.pads.size || Object.values(this.pad).some(Boolean);
      if (held) { this.pads.clear(); this.pad = {}; this.on.change(); }
      return;
    }
    const down = i => Boolean(pad.buttons[i] && pad.buttons[i].pressed);
    const stick = i => {
      const [x, y] = [pad.axes[i] || 0, -(pad.axes[i + 1] || 0)], far = Math.hypot(x, y);
      if (far < 0.15) return null;
      // From 0 at the edge of the dead middle; steps that are seen, not its noise.
      const part = clamp((far - 0.15) / 0.8, 0, 1) / far;
      return [x, y].map(v => Math.round(50 * v * part) / 50);
    };
    const before = JSON.stringify([this.pad, [...this.pads]]);
    this.pad = { stick: stick(0), face: stick(2) };
    this.pads = new Set(down(7) ? ["run"] : []);
    if (before !== JSON.stringify([this.pad, [...this.pads]])) {
      if (this.pad.stick || this.pad.face) this.forget();
      this.on.change();
    }
    this.pad.orbit = (down(4) || down(14)) - (down(5) || down(15));
    this.camera.elevation = clamp(
      this.camera.elevation + 0.015 * (down(12) - down(13)), 0.03, 1.5);
    for (const [i, code] of [[0, "KeyC"], [2, "Previous"], [1, "Next"], [9, "KeyR"]]) {
      if (down(i) && !this.buttons[i]) this.on.key(code);
      this.buttons[i] = down(i);
    }
  }
}
