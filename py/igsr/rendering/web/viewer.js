// The models, camera and options on screen; draws only after changes.

// Vertical field of view without a camera, radians.
const FOV = (50 * Math.PI) / 180;
// Maximum canvas pixels per page pixel; phones have three and more.
const PIXEL_RATIO_MAX = 2;

class Viewer {
  /** `page` has shaders, constants, the background, cameras and the up axis. */
  constructor(canvas, page) {
    Object.assign(this, { canvas, page, flies: false, showsDepth: false });
    this.camera = -1;
    this.fixedSize = null;
    this.frame = 0;
    this.waiters = [];
    this.onChange = () => {};
    this.painter = new Painter(canvas, page);
    // The main model, and the one left of the divider.
    this.main = this.other = null;
    this.divider = 0.5;
    window.addEventListener("resize", () => this.changed());
  }

  /** The page's and the main model's metadata. */
  get scene() {
    return { ...this.page, ...this.main.scene };
  }

  get up() {
    return this.page.up;
  }

  /** Uploads a model and starts its sorter. */
  load(model, scene) {
    const shown = { scene, layer: this.painter.load(model, scene) };
    shown.sorter = new Sorter(model.positions, (order) => {
      this.painter.setOrder(shown.layer, order);
      this.redraw();
    });
    return shown;
  }

  unload(shown) {
    shown.sorter.stop();
    this.painter.unload(shown.layer);
  }

  /** Shows a model, and optionally another left of the divider. The viewpoint stays. */
  show(main, other = null) {
    const before = this.main;
    [this.main, this.other] = [main, other];
    if (before) this.viewpoint = this.viewpoint.between(before.scene, main.scene);
    else this.start();
    this.changed();
  }

  start() {
    this.frameScene();
    if (this.page.cameras.length > 0) this.jump(0);
    this.gestures ||= new Gestures(this);
  }

  /** Changes cameras, background and up axis. The viewpoint stays, once the user has moved it. */
  surround({ cameras, background, up }) {
    const before = this.page.cameras;
    const name = before[this.camera]?.name;
    Object.assign(this.page, { cameras, background, up });
    this.camera = cameras.findIndex((one) => one.name === name);
    if (this.main && before.length === 0 && !this.wasMoved) this.start();
    this.changed();
  }

  /** Goes to a camera by its number, modulo their count. */
  jump(number) {
    const count = this.page.cameras.length;
    if (count === 0) return;
    this.camera = ((number % count) + count) % count;
    const { rows, lens } = this.page.cameras[this.camera];
    this.look(rows, lens);
  }

  /** Sets the camera: world-to-camera matrix, 3 rows of 4; fx, fy, cx, cy, width, height in pixels. */
  look(rows, [fx, fy, cx, cy, width, height]) {
    const { origin, unit, radius } = this.main.scene;
    // The model's coordinates have their own origin and unit.
    const moved = rows.slice();
    for (let i = 0; i < 3; i++) {
      moved[4 * i + 3] = (rows[4 * i + 3] + dot(rows.slice(4 * i, 4 * i + 3), origin)) * unit;
    }
    this.viewpoint = Viewpoint.ofCamera(moved, radius);
    this.lens = { fx, fy, cx, cy, width, height };
    this.changed();
  }

  /** Shows the whole scene from slightly above. */
  frameScene() {
    const { radius } = this.main.scene;
    const [width, height] = this.size();
    const focal = Math.min(width, height) / 2 / Math.tan(FOV / 2);
    this.lens = { fx: focal, fy: focal, cx: width / 2, cy: height / 2, width, height };
    this.viewpoint = Viewpoint.framing(radius, this.up, FOV);
    this.camera = -1;
    this.changed();
  }

  /** Called after the user has moved the viewpoint. */
  moved() {
    this.wasMoved = true;
    this.camera = -1;
    this.changed();
  }

  changed() {
    this.onChange();
    this.redraw();
  }

  redraw() {
    if (this.main) this.frame ||= requestAnimationFrame((now) => this.drawFrame(now));
  }

  size() {
    if (this.fixedSize) return this.fixedSize;
    const ratio = Math.min(window.devicePixelRatio || 1, PIXEL_RATIO_MAX);
    return [this.canvas.clientWidth, this.canvas.clientHeight].map((side) => Math.max(1, Math.round(side * ratio)));
  }

  drawFrame(now) {
    this.frame = 0;
    const moving = this.gestures.step(now);
    this.draw();
    if (moving) this.moved();
    if (!this.frame && this.isSettled) for (const done of this.waiters.splice(0)) done();
  }

  draw() {
    const [width, height] = this.size();
    if (this.canvas.width !== width) this.canvas.width = width;
    if (this.canvas.height !== height) this.canvas.height = height;
    const lens = fittedLens(this.lens, width, height);
    if (this.other) {
      this.drawPart(this.other, this.viewpoint.between(this.main.scene, this.other.scene), lens, 0, this.divider);
    }
    this.drawPart(this.main, this.viewpoint, lens, this.other ? this.divider : 0, 1);
  }

  drawPart({ layer, sorter, scene }, viewpoint, lens, from, to) {
    const { forward, translation } = viewpoint;
    // The file's y and z axes are flipped, as in the painter.
    const axis = [forward[0], -forward[1], -forward[2]];
    sorter.request(axis, translation[2], scene.near);
    this.painter.draw(layer, viewpoint, lens, this.showsDepth, from, to);
  }

  get isSettled() {
    return [this.main, this.other].every((shown) => !shown || shown.sorter.settled);
  }

  /** World units at the pivot per pixel of the page. */
  reach() {
    const [width, height] = this.size();
    const scale = height / Math.max(1, this.canvas.clientHeight);
    return (this.viewpoint.distance * scale) / fittedLens(this.lens, width, height).fy;
  }

  /** Sets the pivot to the surface at a point of the page. */
  focus(clientX, clientY) {
    const [width, height] = this.size();
    const lens = fittedLens(this.lens, width, height);
    const x = Math.min(width - 1, Math.floor((clientX / this.canvas.clientWidth) * width));
    const y = Math.min(height - 1, Math.floor((clientY / this.canvas.clientHeight) * height));
    const depth = this.painter.depthAt(this.main.layer, this.viewpoint, lens, x, y);
    if (depth !== null) {
      const { right, down, forward, position } = this.viewpoint;
      const across = plus(times(right, (x + 0.5 - lens.cx) / lens.fx), down, (y + 0.5 - lens.cy) / lens.fy);
      const target = plus(position, plus(forward, across), depth);
      this.viewpoint.distance = depth;
      this.viewpoint.position = plus(target, forward, -depth);
    }
    this.moved();
  }

  setDepth(shows) {
    this.showsDepth = shows;
    this.changed();
  }

  setFlies(flies) {
    this.flies = flies;
    this.changed();
  }

  /** Handles a key. */
  command(key) {
    const commands = {
      "[": () => this.jump(this.camera < 0 ? 0 : this.camera - 1),
      "]": () => this.jump(this.camera + 1),
      v: () => this.setFlies(!this.flies),
      f: () => this.frameScene(),
      p: () => this.save(),
      1: () => this.setDepth(false),
      4: () => this.setDepth(true),
    };
    const name = key.toLowerCase();
    if (Object.hasOwn(commands, name)) commands[name]();
  }

  /** Saves the picture as PNG. */
  save() {
    this.draw();
    this.canvas.toBlob((blob) => {
      if (!blob) return;
      const link = document.createElement("a");
      link.href = URL.createObjectURL(blob);
      link.download = `${document.title || "scene"}.png`;
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 10000);
    });
  }

  /** Resolves after splats are sorted for the viewpoint and drawn. */
  settled() {
    this.redraw();
    return new Promise((resolve) => this.waiters.push(resolve));
  }
}
