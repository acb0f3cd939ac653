// Starts the page. `window.igsr` is an interface for programs.

const loadingBox = document.getElementById("loading");
const messageBox = document.getElementById("message");
const bar = document.getElementById("bar");

/** Shows a message in the middle of the page; an empty one hides it. */
function say(message) {
  bar.hidden = message !== LOADING;
  loadingBox.hidden = message === "";
  messageBox.textContent = message;
}

function fail(message) {
  window.igsr.error = message;
  say(message);
}

function progress(part) {
  bar.style.width = `${Math.round(100 * part)}%`;
}

async function start() {
  const page = JSON.parse(document.getElementById("scene").textContent);
  const canvas = document.getElementById("canvas");
  canvas.addEventListener("webglcontextlost", () => fail("The graphics device was lost; reload the page."));
  const source = page.live ? new LiveModels() : new EmbeddedModels(page.models);
  if (!page.live && page.models.every(({ count }) => count === 0)) {
    fail("The scene has no splats.");
    return;
  }
  let viewer;
  try {
    viewer = new Viewer(canvas, page);
  } catch (error) {
    throw new Error(`The scene cannot be drawn: ${error.message}.`);
  }
  const models = new Models(viewer, source, progress);
  const panel = new Panel(viewer, models);
  window.igsr.divider = panel.divider;
  makeHandle(window.igsr, viewer, models);
  if (page.live) {
    await follow(viewer, models, source, panel);
    return;
  }
  await models.refresh();
  panel.show();
  await viewer.settled();
  progress(1);
  say("");
}

/** Fills the interface for programs. */
function makeHandle(handle, viewer, models) {
  handle.viewer = viewer;
  handle.models = models;
  handle.state = () => ({
    position: viewer.viewpoint.position,
    forward: viewer.viewpoint.forward,
    distance: viewer.viewpoint.distance,
    camera: viewer.camera,
    flies: viewer.flies,
    showsDepth: viewer.showsDepth,
    blendsFloats: viewer.painter.hasFloats,
  });
  // The picture of a camera in its own size: RGBA, bottom row first.
  handle.picture = async (rows, lens) => {
    viewer.fixedSize = [lens[4], lens[5]];
    viewer.look(rows, lens);
    await viewer.settled();
    viewer.draw();
    return viewer.painter.pixels();
  };
}

window.igsr = { error: null };
window.igsr.ready = start().catch((error) => fail(error.message));
