// The models on screen: the newest or a chosen one, and optionally another to compare.

const LOADING = "Loading …";
// Maximum number of models to keep on the GPU, for fast switching.
const MAX_KEPT_MODELS = 4;

/** Models in the page itself. */
class EmbeddedModels {
  constructor(scenes) {
    this.subject = "The model in this page";
    this.scenes = scenes;
    this.entries = scenes.map(({ label }, k) => ({ id: String(k), label, version: "" }));
    this.newest = this.entries.at(-1)?.id;
  }

  /** Reads a model's metadata and packed bytes. */
  async read(entry, progress) {
    const text = document.getElementById(`model-${entry.id}`).textContent;
    return { scene: this.scenes[Number(entry.id)], packed: await decodeBase64(text, progress) };
  }
}

/** Unpacks a model. Throws an Error if it is damaged. */
async function unpackedModel({ scene, packed }, progress) {
  const bytes = await unpackGzip(packed, PACKED_HEADER, packedSize, progress);
  const model = unpackSplats(bytes);
  if (model.count !== scene.count) throw new Error("its number of splats differs from the page's");
  return model;
}

class Models {
  constructor(viewer, source, progress) {
    Object.assign(this, { viewer, source, progress });
    // Ids; "" is the newest model, and no comparison.
    this.main = this.other = "";
    if (viewer.page.compares) this.other = source.entries[0].id;
    this.kept = new Map();
    this.running = null;
    this.onChange = () => {};
  }

  entry(id) {
    return this.source.entries.find((one) => one.id === id);
  }

  get mainEntry() {
    return this.entry(this.main) ?? this.entry(this.source.newest);
  }

  get otherEntry() {
    const entry = this.entry(this.other);
    return entry === this.mainEntry ? undefined : entry;
  }

  /** Chooses the main model and the one to compare. */
  choose(main, other) {
    [this.main, this.other] = [main, other];
    return this.refresh();
  }

  /** Loads the current versions of the chosen models; the old ones stay until then. */
  refresh() {
    this.isWanted = true;
    this.running ??= this.run().finally(() => {
      this.running = null;
    });
    return this.running;
  }

  async run() {
    while (this.isWanted) {
      this.isWanted = false;
      const [main, other] = [this.mainEntry, this.otherEntry];
      if (!main) continue;
      const shown = await this.ready(main);
      const beside = other ? await this.ready(other) : null;
      this.viewer.show(shown, beside);
      this.forget([shown, beside]);
      this.onChange();
    }
  }

  async ready(entry) {
    const key = `${entry.id} ${entry.version}`;
    let shown = this.kept.get(key);
    if (!shown) {
      try {
        const read = await this.source.read(entry, (part) => this.progress(0.4 * part));
        const model = await unpackedModel(read, (part) => this.progress(0.4 + 0.4 * part));
        await breathe();
        shown = this.viewer.load(model, read.scene);
      } catch (error) {
        throw new Error(`${this.source.subject} cannot be read: ${error.message.replace(/\.$/, "")}.`, { cause: error });
      }
    }
    // The map is ordered by last use.
    this.kept.delete(key);
    this.kept.set(key, shown);
    return shown;
  }

  forget(used) {
    const current = new Set(this.source.entries.map(({ id, version }) => `${id} ${version}`));
    for (const [key, shown] of this.kept) {
      if (used.includes(shown) || (current.has(key) && this.kept.size <= MAX_KEPT_MODELS)) continue;
      this.viewer.unload(shown);
      this.kept.delete(key);
    }
  }
}
