// Follows the server of `igsr view --web`: requests its state once a second.

const POLL_MS = 1000;
const NARROW_PX = 700;

/** Models of the server. Addresses are relative to the page's, which contains the token. */
class LiveModels {
  constructor() {
    this.subject = "The model";
    this.entries = [];
    this.newest = undefined;
  }

  async read({ id, version }, progress) {
    const query = new URLSearchParams({ id, version });
    const answer = await fetch(`model?${query}`);
    if (!answer.ok) throw new Error(await answer.text());
    const bytes = new Uint8Array(await answer.arrayBuffer());
    progress(1);
    // The length of a JSON text, the text, and the packed model.
    const end = 4 + new DataView(bytes.buffer).getUint32(0, true);
    const scene = JSON.parse(new TextDecoder().decode(bytes.subarray(4, end)));
    return { scene, packed: bytes.subarray(end) };
  }
}

async function askServer(path) {
  const answer = await fetch(path);
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}

/** Shows the server's state repeatedly; resolves after the first time. */
async function follow(viewer, models, source, panel) {
  const status = new Status();
  let [surroundings, showing, problem] = ["", "", ""];
  const refresh = async () => {
    problem = "";
    if (!viewer.main && models.mainEntry) say(LOADING);
    try {
      await models.refresh();
    } catch (error) {
      // The file is damaged or was just replaced: the current models stay.
      problem = error.message;
      // After a broken connection, request the same again.
      if (error.cause instanceof TypeError) showing = "";
    }
  };
  const step = async () => {
    const state = await askServer("state");
    status.show(state);
    if (state.surroundings !== surroundings) {
      viewer.surround(await askServer("surroundings"));
      surroundings = state.surroundings;
    }
    Object.assign(source, { entries: state.models, newest: state.newest });
    const wanted = JSON.stringify([models.mainEntry, models.otherEntry]);
    if (wanted !== showing) {
      showing = wanted;
      await refresh();
    }
    panel.update();
    if (viewer.main) panel.show();
    say(problem || (viewer.main ? "" : "There is no model yet; it is shown as soon as there is one."));
  };
  const again = async () => {
    try {
      // Hidden pages do not poll.
      if (!document.hidden) await step();
    } catch (error) {
      status.lost(error instanceof TypeError ? "igsr view does not answer; the page asks again." : error.message);
    }
    setTimeout(again, POLL_MS);
  };
  await again();
}

/** Progress and scores of a run. */
class Status {
  constructor() {
    this.box = document.getElementById("status");
    // On narrow screens it would hide the scene.
    this.box.open = window.innerWidth >= NARROW_PX;
  }

  lost(message) {
    this.box.hidden = false;
    document.getElementById("run").textContent = message;
  }

  show({ title, run, scores }) {
    document.title = title;
    document.getElementById("title").textContent = title;
    const text = document.getElementById("run");
    const done = document.getElementById("done");
    text.textContent = run ? run.text : "";
    done.hidden = !run;
    if (run) done.value = run.done;
    const table = document.getElementById("scores");
    const line = (tag, cells) => {
      const row = document.createElement("tr");
      row.append(...cells.map((cell) => Object.assign(document.createElement(tag), { textContent: cell })));
      return row;
    };
    table.replaceChildren(...(scores.rows.length > 0 ? [line("th", scores.head), ...scores.rows.map((row) => line("td", row))] : []));
    this.box.hidden = false;
  }
}
