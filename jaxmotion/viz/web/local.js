// Frames from a Worker: the static page, for which nobody has to serve anything.

import { start } from "./page.js";

class Local {
  constructor(base) {
    this.base = base; this.open = true; this.waiting = "starting";
  }

  // Calls `on.state`, `on.body`, `on.frame` and `on.error` from now on.
  connect(on, settings) {
    this.worker = new Worker(new URL("worker.js", this.base), { type: "module" });
    this.worker.onmessage = ({ data }) => {
      if (data.state) on.state(data.state);
      if (data.body) on.body(data.body.buffer, data.engine);
      if (data.frame) on.frame(data.frame, data.due - performance.timeOrigin);
    };
    this.worker.onerror = event => {
      event.preventDefault();
      on.error(`worker.js does not run: ${event.message || "it is missing"}`);
    };
    this.say({ base: this.base, settings });
  }

  say(message) { if (this.worker) this.worker.postMessage(message); }
}

start(new Local(new URL(".", location.href).href));
