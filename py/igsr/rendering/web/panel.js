// The buttons below the picture.

function makePanel(viewer) {
  const get = (id) => document.getElementById(id);
  const cameras = viewer.scene.cameras;
  get("photos").hidden = cameras.length === 0;
  const list = get("cameras");
  list.add(new Option("free view", "-1"));
  cameras.forEach(({ name }, number) => list.add(new Option(name, String(number))));
  list.addEventListener("change", () => {
    if (Number(list.value) >= 0) viewer.jump(Number(list.value));
    // Keys move the camera again, and do not choose another.
    list.blur();
  });
  const actions = {
    previous: () => viewer.command("["),
    next: () => viewer.command("]"),
    mode: () => viewer.setFlies(!viewer.flies),
    depth: () => viewer.setDepth(!viewer.showsDepth),
    fit: () => viewer.frameScene(),
    save: () => viewer.save(),
    help: () => {
      get("keys").hidden = !get("keys").hidden;
      get("help").setAttribute("aria-pressed", String(!get("keys").hidden));
    },
  };
  for (const [id, action] of Object.entries(actions)) get(id).addEventListener("click", action);
  viewer.onChange = () => {
    list.value = String(viewer.camera);
    get("mode").textContent = viewer.flies ? "Fly" : "Orbit";
    get("depth").setAttribute("aria-pressed", String(viewer.showsDepth));
  };
  viewer.onChange();
  get("panel").hidden = false;
}
