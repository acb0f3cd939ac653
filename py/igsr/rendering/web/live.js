// Follows the server of `igsr view --web`: what there is to show, asked for once a second.

const ASK_EVERY = 1000; // milliseconds

/** Models that the server has. Its addresses are relative to the page's, which has the token. */
class LiveModels {
  constructor() {
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

/** Shows what the server has, again and again; resolves after the first time. */
async function follow(viewer, models, source, panel) {
  const status = new Status();
  let surroundings = "";
  let showing = "";
  const step = async () => {
    let state;
    try {
      state = await askServer("state");
    } catch {
      status.lost();
      return;
    }
    status.show(state);
    if (state.surroundings !== surroundings) {
      surroundings = state.surroundings;
      viewer.surround(await askServer("surroundings"));
    }
    Object.assign(source, { entries: state.models, newest: state.newest });
    const wanted = JSON.stringify([models.mainEntry, models.otherEntry]);
    if (wanted !== showing) {
      showing = wanted;
      if (!viewer.main && models.mainEntry) say(LOADING);
      await models.refresh();
    }
    if (viewer.main) {
      panel.show();
      say("");
    } else {
      say("There is no model yet; it is shown as soon as there is one.");
    }
  };
  const again = async () => {
    try {
      await step();
    } catch (error) {
      // A file that was just replaced, or a damaged one: what is shown stays.
      say(error.message);
    }
    setTimeout(again, ASK_EVERY);
  };
  await again();
}

/** What is said of a run: how far it is, and its scores. */
class Status {
  constructor() {
    this.box = document.getElementById("status");
  }

  lost() {
    this.box.hidden = false;
    document.getElementById("run").textContent = "igsr view does not answer; the page asks again.";
  }

  show({ title, run, scores }) {
    document.title = title;
    document.getElementById("title").textContent = title;
    const text = document.getElementById("run");
    const done = document.getElementById("done");
    text.textContent = run ? run.text : "";
    done.hidden = !run;
    if (run) done.value = run.done;
    const rows = scores.rows.map(([label, ...values]) => [label, ...values]);
    const table = document.getElementById("scores");
    const line = (tag, cells) => {
      const row = document.createElement("tr");
      row.append(...cells.map((cell) => Object.assign(document.createElement(tag), { textContent: cell })));
      return row;
    };
    table.replaceChildren(...(rows.length > 0 ? [line("th", scores.head), ...rows.map((row) => line("td", row))] : []));
    this.box.hidden = false;
  }
}
