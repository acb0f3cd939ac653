// The buttons and lists below the picture.

const PHOTO = "photo";

class Panel {
  constructor(viewer, models) {
    Object.assign(this, { viewer, models, divider: new Divider(viewer) });
    this.cameras = this.element("cameras");
    this.shown = this.element("shown");
    this.beside = this.element("beside");
    this.listed = "";
    this.cameras.addEventListener("change", () => {
      const number = Number(this.cameras.value);
      if (number >= 0) viewer.jump(number);
    });
    for (const list of [this.shown, this.beside]) list.addEventListener("change", () => this.choose());
    // Keys move the camera again instead of changing the choice.
    for (const list of [this.cameras, this.shown, this.beside]) list.addEventListener("change", () => list.blur());
    const keys = this.element("keys");
    const actions = {
      previous: () => viewer.command("["),
      next: () => viewer.command("]"),
      mode: () => viewer.setFlies(!viewer.flies),
      depth: () => viewer.setDepth(!viewer.showsDepth),
      fit: () => viewer.frameScene(),
      save: () => viewer.save(),
      help: () => {
        keys.hidden = !keys.hidden;
        this.element("help").setAttribute("aria-pressed", String(!keys.hidden));
      },
    };
    for (const [id, action] of Object.entries(actions)) this.element(id).addEventListener("click", action);
    viewer.onChange = models.onChange = () => this.update();
  }

  element(id) {
    return document.getElementById(id);
  }

  show() {
    this.update();
    this.element("panel").hidden = false;
  }

  choose() {
    const other = this.beside.value;
    this.divider.wantsPhoto = other === PHOTO;
    const { viewer } = this;
    if (this.divider.wantsPhoto && viewer.page.cameras[viewer.camera]?.photo === undefined) {
      const number = viewer.page.cameras.findIndex(({ photo }) => photo !== undefined);
      if (number >= 0) viewer.jump(number);
    }
    this.models.choose(this.shown.value, other === PHOTO ? "" : other).catch((error) => say(error.message));
    this.update();
  }

  /** Updates the lists, if they have changed, and their choices. */
  update() {
    const { viewer, models, divider } = this;
    const { cameras } = viewer.page;
    const { entries } = models.source;
    const hasPhotos = cameras.some(({ photo }) => photo !== undefined);
    const names = cameras.map(({ name }) => name);
    const listed = JSON.stringify([names, hasPhotos, entries.map(({ id, label }) => [id, label])]);
    if (listed !== this.listed) {
      this.listed = listed;
      const fill = (list, options) => list.replaceChildren(...options.map(([text, value]) => new Option(text, value)));
      const all = entries.map(({ id, label }) => [label, id]);
      fill(this.cameras, [["free view", "-1"], ...names.map((name, k) => [name, String(k)])]);
      fill(this.shown, [...(viewer.page.live ? [["Show the newest", ""]] : []), ...all]);
      const others = [...(hasPhotos ? [["the photo", PHOTO]] : []), ...all];
      fill(this.beside, [["Compare with …", ""], ...others.map(([text, value]) => [`Left: ${text}`, value])]);
    }
    this.element("photos").hidden = names.length === 0;
    this.element("models").hidden = entries.length < 2 && !hasPhotos;
    this.cameras.value = String(viewer.camera);
    this.shown.value = models.entry(models.main)?.id ?? (viewer.page.live ? "" : models.source.newest);
    this.beside.value = divider.wantsPhoto ? PHOTO : models.entry(models.other) ? models.other : "";
    divider.labels = [divider.wantsPhoto ? "photo" : models.otherEntry?.label ?? "", models.mainEntry?.label ?? ""];
    this.element("mode").textContent = viewer.flies ? "Fly" : "Orbit";
    this.element("depth").setAttribute("aria-pressed", String(viewer.showsDepth));
    if (viewer.main) divider.place();
  }
}
