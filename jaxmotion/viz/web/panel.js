// The panel: what can be chosen, as the source of frames says, and what it takes.

const $ = id => document.getElementById(id);
const RANGES = ["speed", "num_steps", "scale", "characters"];
const DIGITS = { speed: 1, scale: 2 };

export class Panel {
  // say: sends a message to the source; on: `reset()`, `save(suffix)`, `link()`,
  // `wear(file or null)`.
  constructor(say, on) {
    this.say = say; this.state = null; this.error = ""; this.until = 0; this.waiting = "";
    for (const name of RANGES) {
      $(name).oninput = () => {
        this.label(name);
        // The speed is no other program: it follows the slider at once.
        if (name === "speed") this.set(name, +$(name).value);
      };
      $(name).onchange = () => { this.set(name, this.value(name)); $(name).blur(); };
    }
    for (const name of ["foot_lock", "plan"])
      $(name).onchange = e => { this.set(name, e.target.checked); e.target.blur(); };
    $("model").onchange = e => { this.set("model", e.target.value); e.target.blur(); };
    $("paused").onclick = e => { this.set("paused", !this.state.paused); e.target.blur(); };
    $("step").onclick = e => { say({ do: "step" }); e.target.blur(); };
    $("record").onclick = e => { say({ do: "record" }); e.target.blur(); };
    $("reset").onclick = e => { on.reset(); say({ do: "reset" }); e.target.blur(); };
    $("link").onclick = e => { on.link(); e.target.blur(); };
    $("wear").onclick = e => { $("file").click(); e.target.blur(); };
    $("file").onchange = e => {
      if (e.target.files.length) on.wear(e.target.files[0]);
      e.target.value = "";
    };
    $("bare").onclick = e => { on.wear(null); e.target.blur(); };
    $("fold").onclick = e => { $("panel").classList.toggle("folded"); e.target.blur(); };
    for (const button of $("save").querySelectorAll("button"))
      button.onclick = e => { say({ save: button.textContent }); e.target.blur(); };
    for (const button of $("last").querySelectorAll("button"))
      button.onclick = e => { on.save(button.textContent); e.target.blur(); };
    if (matchMedia("(max-width: 700px)").matches) $("panel").classList.add("folded");
  }

  set(name, value) { if (this.state) this.say({ set: { [name]: value } }); }

  // Another label, by its index.
  choose(label) {
    const { labels } = this.state || { labels: [] };
    if (labels.length) this.set("label", (label + labels.length) % labels.length);
  }

  // Crouches, or stands up to the label of before.
  crouch() {
    if (!this.state) return;
    const { labels, label } = this.state;
    const low = labels.findIndex(x => /crouch/i.test(x));
    if (low < 0) return;
    if (label !== low) this.upright = label;
    this.choose(label === low ? this.upright || 0 : low);
  }

  // Sliders of choices that are no range have their index.
  value(name) {
    const at = +$(name).value;
    return name === "num_steps" ? this.state.steps[at] : at;
  }

  label(name) {
    const value = this.state && this.value(name);
    $(name).parentNode.querySelector("output").textContent =
      Number.isFinite(value) ? value.toFixed(DIGITS[name] || 0) : "";
  }

  fill(name, low, high, value = this.state[name]) {
    const field = $(name);
    if (document.activeElement === field) return;
    field.min = low; field.max = high; field.value = value; this.label(name);
  }

  show(state) {
    this.state = state;
    const models = $("model"), labels = $("labels");
    if (models.dataset.of !== state.models.join()) {
      models.dataset.of = state.models.join();
      models.replaceChildren(
        ...state.models.map(x => new Option(x.split(/[/\\]/).pop() || x, x)));
    }
    models.value = state.model;
    if (labels.dataset.of !== state.labels.join()) {
      labels.dataset.of = state.labels.join();
      labels.replaceChildren(...state.labels.map((name, i) => {
        const button = document.createElement("button");
        const small = document.createElement("small");
        small.textContent = i < 9 ? i + 1 : ""; button.append(small, name);
        button.onclick = () => { this.choose(i); button.blur(); };
        return button;
      }));
    }
    [...labels.children].forEach((x, i) => x.classList.toggle("on", i === state.label));
    this.fill("speed", ...state.speeds);
    this.fill("characters", 1, state.most_characters);
    const { steps, scales } = state;
    this.fill("num_steps", 0, Math.max(steps.length - 1, 0),
      Math.max(steps.indexOf(state.num_steps), 0));
    $("num_steps").disabled = steps.length < 2;
    if (scales) { $("scale").step = (scales[1] - scales[0]) / 40; this.fill("scale", ...scales); }
    $("scale").disabled = !scales;
    $("foot_lock").checked = state.foot_lock && state.lockable;
    $("foot_lock").disabled = !state.lockable;
    $("plan").checked = state.plan && state.planning;
    $("plan").disabled = !state.planning;
    $("paused").textContent = state.paused ? "play" : "pause";
    $("paused").classList.toggle("on", state.paused);
    $("step").disabled = !state.paused;
    $("record").hidden = state.recordable === false;
    $("record").classList.toggle("on", state.recording);
    $("record").textContent = state.recording ? "stop" : "record";
    $("save").style.display = state.taken ? "" : "none";
    $("taken").textContent = `take of ${state.taken.toFixed(1)} s:`;
    $("source").textContent = state.source;
    this.note();
  }

  // The name of the file that is worn; null for none.
  wears(name) {
    $("wear").textContent = name || "choose a .glb";
    $("bare").hidden = !name;
  }

  // An error, for six seconds.
  fail(text) {
    this.error = text; this.until = Date.now() + 6000; this.note();
    setTimeout(() => this.note(), 6100);
  }

  // What the page waits for, or what is wrong, in one line.
  note() {
    let text = "", kind = "busy";
    if (this.broken) { text = this.broken; kind = "bad"; }
    else if (this.waiting) text = this.waiting;
    else if (Date.now() < this.until) { text = this.error; kind = "bad"; }
    else if (this.state && this.state.note) {
      text = this.state.note; if (text.startsWith("error")) kind = "bad";
    }
    const box = $("note");
    box.style.display = text ? "block" : "none";
    box.className = "card " + kind; box.textContent = text;
  }

  saved(name) {
    $("saved").innerHTML = "saved <a></a>";
    const link = $("saved").firstElementChild;
    link.href = `/takes/${name}`; link.textContent = name;
  }

  // Bars of what the last ticks took; `history`: [milliseconds, plans] each.
  plot(history, fps, rate) {
    const c = $("plot"), ratio = devicePixelRatio || 1, pen = c.getContext("2d");
    const w = c.width = c.clientWidth * ratio, h = c.height = c.clientHeight * ratio;
    const budget = 1000 / fps, most = Math.max(1.6 * budget, ...history.map(x => x[0]));
    const y = ms => h - ms / most * h, step = w / 240;
    history.forEach(([ms, plans], i) => {
      pen.fillStyle = ms > budget ? "#d63a3a" : plans ? "#2878c8" : "#b9c6d4";
      pen.fillRect(i * step, y(ms), Math.max(step - 0.5, 1), h);
    });
    pen.strokeStyle = "#20262e"; pen.setLineDash([4, 3]); pen.beginPath();
    pen.moveTo(0, y(budget)); pen.lineTo(w, y(budget)); pen.stroke();
    // Who makes frame after frame has no plans.
    const planned = history.filter(x => x[1]), all = planned.length ? planned : history;
    const median = all.map(x => x[0]).sort((a, b) => a - b)[all.length >> 1];
    const plans = planned.reduce((sum, x) => sum + x[1], 0) * rate / history.length;
    $("numbers").textContent = (planned.length
      ? `plan ${median.toFixed(0)} ms · ${plans.toFixed(1)} plans/s · `
      : `frame ${median.toFixed(1)} ms · `)
      + `${rate.toFixed(0)} of ${fps.toFixed(0)} frames/s`;
  }
}
