// Loads the model and starts the viewer. `window.igsr` lets a program look on and steer.

const messageBox = document.getElementById("message");
const bar = document.getElementById("bar");

function fail(message) {
  window.igsr.error = message;
  bar.hidden = true;
  document.getElementById("loading").hidden = false;
  messageBox.textContent = message;
}

function progress(part) {
  bar.style.width = `${Math.round(100 * part)}%`;
}

async function loadModel(scene) {
  const element = document.getElementById("model");
  const text = element.textContent;
  // The text is the page's largest part.
  element.remove();
  try {
    const packed = await decodeBase64(text, (part) => progress(0.4 * part));
    const bytes = await unpackGzip(packed, PACKED_HEADER, packedSize, (part) => progress(0.4 + 0.4 * part));
    const model = unpackSplats(bytes);
    if (model.count !== scene.count) throw new Error("it does not have as many splats as the page says");
    return model;
  } catch (error) {
    throw new Error(`The model in this page cannot be read: ${error.message}.`);
  }
}

async function start() {
  const scene = JSON.parse(document.getElementById("scene").textContent);
  if (scene.count === 0) {
    fail("The scene has no splats.");
    return;
  }
  const model = await loadModel(scene);
  await breathe();
  const canvas = document.getElementById("canvas");
  canvas.addEventListener("webglcontextlost", () => fail("The graphics device was lost; reload the page."));
  let viewer;
  try {
    viewer = new Viewer(canvas, model, scene);
  } catch (error) {
    throw new Error(`The scene cannot be drawn: ${error.message}.`);
  }
  makePanel(viewer);
  await viewer.settled();
  progress(1);
  document.getElementById("loading").hidden = true;
  window.igsr.viewer = viewer;
  window.igsr.state = () => ({
    position: viewer.viewpoint.position,
    forward: viewer.viewpoint.forward,
    distance: viewer.viewpoint.distance,
    camera: viewer.camera,
    flies: viewer.flies,
    showsDepth: viewer.showsDepth,
    blendsFloats: viewer.painter.hasFloats,
  });
  // The picture of one camera in its own size: RGBA, the lowest row first.
  window.igsr.picture = async (rows, lens) => {
    viewer.fixedSize = [lens[4], lens[5]];
    viewer.look(rows, lens);
    await viewer.settled();
    viewer.draw();
    return viewer.painter.pixels();
  };
}

window.igsr = { error: null };
window.igsr.ready = start().catch((error) => fail(error.message));
