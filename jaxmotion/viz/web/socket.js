// Frames from a server over a WebSocket: the live page of `experiments/steer.py`.

import { start } from "./page.js";

class Socket {
  open = false; waiting = "connecting";

  connect(on, settings) {
    const address = location.origin.replace("http", "ws") + "/live";
    const socket = this.socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    socket.onmessage = async ({ data }) => {
      if (typeof data !== "string")
        return on.frame(new Float32Array(data), performance.now());
      const message = JSON.parse(data);
      if (message.state) on.state(message.state);
      if (message.body) {
        const found = await fetch(`/body/${message.body}`);
        if (found.ok) on.body(await found.arrayBuffer(), message.body);
      }
      if (message.error) on.error(message.error);
      if (message.saved) on.saved(message.saved);
    };
    socket.onopen = () => { this.open = true; on.open(); };
    socket.onclose = () => {
      this.open = false; on.open();
      setTimeout(() => this.connect(on, settings), 1000);
    };
  }

  say(message) {
    if (this.socket && this.socket.readyState === 1) this.socket.send(JSON.stringify(message));
  }
}

start(new Socket());
