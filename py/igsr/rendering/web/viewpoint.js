// A viewpoint and its movements. Camera axes: x right, y down, z forward. The origin is the
// scene's center.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
/** a + s b */
const plus = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const times = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const unitVector = (a) => times(a, 1 / (Math.hypot(...a) || 1));

/** Rotates `v` around a unit axis, right-handed, by radians. */
function turned(v, axis, angle) {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  return plus(plus(times(v, c), cross(axis, v), s), axis, dot(axis, v) * (1 - c));
}

/** Any perpendicular unit vector. */
function anyNormal(v) {
  return unitVector(cross(v, Math.abs(v[0]) < 0.5 ? [1, 0, 0] : [0, 1, 0]));
}

// Minimum angle between the viewing direction and the up axis, radians.
const POLE = 0.02;
// Elevation of the view of the whole scene, radians.
const ELEVATION = Math.PI / 12;

class Viewpoint {
  /** `right`, `down`, `forward`: the camera's axes in the world; the pivot is `distance` ahead. */
  constructor(position, right, down, forward, distance) {
    Object.assign(this, { position, right, down, forward, distance });
  }

  static looking(position, target, up) {
    const forward = unitVector(plus(target, position, -1));
    let right = cross(forward, up);
    right = Math.hypot(...right) > 1e-9 ? unitVector(right) : anyNormal(forward);
    return new Viewpoint(position, right, cross(forward, right), forward, Math.hypot(...plus(target, position, -1)));
  }

  /** A view from slightly above in which a ball around the origin fills the picture. `fov`: radians. */
  static framing(radius, up, fov) {
    const usual = Math.abs(up[2]) > 0.9 ? [0, 1, 0] : [0, 0, 1];
    let level = plus(usual, up, -dot(up, usual));
    level = Math.hypot(...level) > 1e-9 ? unitVector(level) : anyNormal(up);
    const distance = (1.1 * radius) / Math.sin(fov / 2);
    const back = plus(times(level, -Math.cos(ELEVATION)), up, Math.sin(ELEVATION));
    return Viewpoint.looking(times(back, distance), [0, 0, 0], up);
  }

  /** From a world-to-camera matrix, 3 rows of 4; the pivot is the point ahead nearest to the origin. */
  static ofCamera(rows, radius) {
    const [right, down, forward] = [0, 1, 2].map((i) => rows.slice(4 * i, 4 * i + 3));
    const axes = [right, down, forward];
    const position = axes.reduce((sum, axis, i) => plus(sum, axis, -rows[4 * i + 3]), [0, 0, 0]);
    const ahead = -dot(forward, position);
    return new Viewpoint(position, right, down, forward, Math.max(ahead, 0.1 * radius));
  }

  /** Converts to another model's coordinates, with its origin and unit. */
  between(from, to) {
    const world = plus(times(this.position, 1 / from.unit), from.origin);
    const position = times(plus(world, to.origin, -1), to.unit);
    return new Viewpoint(position, this.right, this.down, this.forward, (this.distance * to.unit) / from.unit);
  }

  get pivot() {
    return plus(this.position, this.forward, this.distance);
  }

  /** The world-to-camera translation. */
  get translation() {
    return [this.right, this.down, this.forward].map((axis) => -dot(axis, this.position));
  }

  /** Looks around: radians to the right around `up`, and upward, but not past the poles. */
  turn(yaw, pitch, up) {
    const fromUp = Math.acos(Math.min(1, Math.max(-1, dot(this.forward, up))));
    const lean = Math.min(fromUp - POLE, Math.max(fromUp - (Math.PI - POLE), pitch));
    const right = this.right;
    const move = (v) => turned(turned(v, right, lean), up, -yaw);
    this.forward = unitVector(move(this.forward));
    // Orthonormalized, so that rounding errors do not accumulate.
    this.down = unitVector(cross(this.forward, move(right)));
    this.right = cross(this.down, this.forward);
  }

  orbit(yaw, pitch, up) {
    const pivot = this.pivot;
    this.turn(yaw, pitch, up);
    this.position = plus(pivot, this.forward, -this.distance);
  }

  /** Moves the pivot with the pointer: world units to the right and down. */
  pan(right, down) {
    this.position = plus(plus(this.position, this.right, -right), this.down, -down);
  }

  zoom(factor) {
    const pivot = this.pivot;
    this.distance = Math.min(1e9, Math.max(1e-6, this.distance / factor));
    this.position = plus(pivot, this.forward, -this.distance);
  }

  move(right, up, ahead) {
    const moved = plus(plus(this.position, this.right, right), this.down, -up);
    this.position = plus(moved, this.forward, ahead);
  }
}

/** Fits a lens to another picture size, so that its whole picture is visible. */
function fittedLens(lens, width, height) {
  const scale = Math.min(width / lens.width, height / lens.height);
  return {
    fx: lens.fx * scale,
    fy: lens.fy * scale,
    cx: 0.5 * width + (lens.cx - 0.5 * lens.width) * scale,
    cy: 0.5 * height + (lens.cy - 0.5 * lens.height) * scale,
    width,
    height,
  };
}
