// Moves the viewpoint by drags, wheel, touches and keys.

const TURN = 0.005; // radians per pixel of a drag
const TURN_KEYS = 1.2; // radians per second of an arrow key
const WHEEL = 0.002; // logarithm of the zoom factor, per pixel of the wheel
const SPEED = 0.8; // of keys, distances to the pivot per second
const FAST = 4; // factor of the speed with Shift
const MAX_STEP_S = 0.1; // maximum time step of a movement by key, to avoid jumps after a pause
const LINE = 40; // pixels per line of the wheel

class Gestures {
  constructor(viewer) {
    this.viewer = viewer;
    this.pointers = new Map();
    this.down = new Set();
    this.last = 0;
    const canvas = viewer.canvas;
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("dblclick", (event) => viewer.focus(event.clientX, event.clientY));
    window.addEventListener("keydown", (event) => this.pressKey(event));
    window.addEventListener("keyup", (event) => this.down.delete(event.code));
    window.addEventListener("blur", () => this.down.clear());
  }

  press(event) {
    const { clientX: x, clientY: y } = event;
    this.viewer.canvas.focus();
    try {
      this.viewer.canvas.setPointerCapture(event.pointerId);
    } catch {
      // The pointer is already gone.
    }
    this.pointers.set(event.pointerId, { x, y, pans: event.button !== 0 || event.shiftKey });
  }

  drag(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const { clientX: x, clientY: y } = event;
    const others = [...this.pointers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
    const { viewpoint, up, flies } = this.viewer;
    const reach = this.viewer.reach();
    if (others.length > 0) {
      // Two fingers: each contributes half of the shift, and their distance zooms.
      viewpoint.pan(((x - before.x) / 2) * reach, ((y - before.y) / 2) * reach);
      const apart = (at) => Math.hypot(at.x - others[0].x, at.y - others[0].y);
      if (apart(before) > 1 && apart({ x, y }) > 1) this.zoom(apart({ x, y }) / apart(before));
    } else if (before.pans) {
      viewpoint.pan((x - before.x) * reach, (y - before.y) * reach);
    } else {
      const [yaw, pitch] = [(x - before.x) * TURN, -(y - before.y) * TURN];
      if (flies) viewpoint.turn(yaw, pitch, up);
      else viewpoint.orbit(yaw, pitch, up);
    }
    this.pointers.set(event.pointerId, { ...before, x, y });
    this.viewer.moved();
  }

  wheel(event) {
    event.preventDefault();
    const unit = event.deltaMode === WheelEvent.DOM_DELTA_PIXEL ? 1 : LINE;
    // A pinch on a touch pad is a wheel event with Ctrl and small deltas.
    this.zoom(Math.exp(-event.deltaY * unit * WHEEL * (event.ctrlKey ? 5 : 1)));
    this.viewer.moved();
  }

  zoom(factor) {
    const { viewpoint, flies } = this.viewer;
    if (flies) viewpoint.move(0, 0, Math.log(factor) * viewpoint.distance);
    else viewpoint.zoom(factor);
  }

  pressKey(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
    const moves = /^(Key[WASDQE]|Arrow(Left|Right|Up|Down))$/.test(event.code);
    if (moves) {
      event.preventDefault();
      if (this.down.size === 0) this.last = performance.now();
      this.down.add(event.code);
      this.viewer.moved();
    } else if (!event.repeat) {
      this.viewer.command(event.key);
    }
    this.isFast = event.shiftKey;
  }

  /** Moves by the pressed keys, before each frame. Returns whether a key is pressed. */
  step(now) {
    if (this.down.size === 0) return false;
    const seconds = Math.min(MAX_STEP_S, Math.max(0, (now - this.last) / 1000));
    this.last = now;
    const pair = (less, more) => Number(this.down.has(more)) - Number(this.down.has(less));
    const { viewpoint, up, flies } = this.viewer;
    const length = seconds * SPEED * viewpoint.distance * (this.isFast ? FAST : 1);
    viewpoint.move(pair("KeyA", "KeyD") * length, pair("KeyQ", "KeyE") * length, pair("KeyS", "KeyW") * length);
    const yaw = pair("ArrowLeft", "ArrowRight") * TURN_KEYS * seconds;
    const pitch = pair("ArrowDown", "ArrowUp") * TURN_KEYS * seconds;
    if (yaw || pitch) {
      if (flies) viewpoint.turn(yaw, pitch, up);
      else viewpoint.orbit(-yaw, -pitch, up);
    }
    return true;
  }
}
