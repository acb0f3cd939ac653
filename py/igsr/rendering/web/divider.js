// The divider: another model or the current camera's photo on its left.

const KEY_STEP = 0.02; // fraction of the width per arrow key

class Divider {
  constructor(viewer) {
    this.viewer = viewer;
    this.line = document.getElementById("divider");
    this.photo = document.getElementById("photo");
    this.wantsPhoto = false;
    this.labels = ["", ""];
    this.photo.addEventListener("load", () => this.place());
    this.line.addEventListener("pointerdown", (event) => this.line.setPointerCapture(event.pointerId));
    this.line.addEventListener("pointermove", (event) => {
      if (event.buttons) this.move(event.clientX / viewer.canvas.clientWidth);
    });
    this.line.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: -KEY_STEP, ArrowRight: KEY_STEP }[event.key];
      if (step === undefined) return;
      event.preventDefault();
      // The key would also turn the camera.
      event.stopPropagation();
      this.move(viewer.divider + step);
    });
  }

  move(part) {
    this.viewer.divider = Math.min(1, Math.max(0, part));
    this.viewer.redraw();
    this.place();
  }

  /** Updates the positions of the line and the photo, and the labels. */
  place() {
    const { viewer, photo, line } = this;
    const { clientWidth: width, clientHeight: height } = viewer.canvas;
    const source = this.wantsPhoto ? viewer.page.cameras[viewer.camera]?.photo : undefined;
    if (source === undefined) photo.removeAttribute("src");
    else if (photo.getAttribute("src") !== source) photo.src = source;
    photo.hidden = source === undefined || !photo.complete;
    const at = viewer.divider * width;
    if (!photo.hidden) {
      const { width: w, height: h } = viewer.lens;
      const scale = Math.min(width / w, height / h);
      const left = (width - scale * w) / 2;
      Object.assign(photo.style, {
        left: `${left}px`,
        top: `${(height - scale * h) / 2}px`,
        width: `${scale * w}px`,
        height: `${scale * h}px`,
        clipPath: `inset(0 ${Math.min(scale * w, Math.max(0, left + scale * w - at))}px 0 0)`,
      });
    }
    line.hidden = !viewer.other && !this.wantsPhoto;
    line.style.left = `${at}px`;
    line.setAttribute("aria-valuenow", String(Math.round(100 * viewer.divider)));
    const [before, after] = this.labels;
    const isAway = this.wantsPhoto && source === undefined;
    // Above the buttons, which take several rows on a phone.
    const bottom = `${document.getElementById("panel").offsetHeight + 8}px`;
    for (const id of ["before", "after"]) document.getElementById(id).style.bottom = bottom;
    document.getElementById("before").textContent = isAway ? "go to a photo's camera" : before;
    document.getElementById("after").textContent = after;
  }
}
