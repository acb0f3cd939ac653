// Sorts splats by depth, farthest first, in a worker.

/**
 * Sorts by depth, in one counting sort on 16 bits. Self-contained, since its source also runs in
 * the worker. `positions` has 3 numbers per splat; depth is `axis`·position + `offset`. Returns the
 * indices of splats that are not nearer than `near`, a Uint32Array.
 */
function sortByDepth(positions, axis, offset, near) {
  const count = positions.length / 3;
  const depths = new Float32Array(count);
  // The bits of positive floats have the order of the floats and are nearly logarithmic, so that
  // far splats do not make the steps between near ones coarse.
  const bits = new Uint32Array(depths.buffer);
  const [ax, ay, az] = axis;
  let least = 0xffffffff;
  let most = 0;
  for (let i = 0; i < count; i++) {
    const z = ax * positions[3 * i] + ay * positions[3 * i + 1] + az * positions[3 * i + 2] + offset;
    depths[i] = z >= near ? z : 0;
    if (bits[i] === 0) continue;
    if (bits[i] < least) least = bits[i];
    if (bits[i] > most) most = bits[i];
  }
  let shift = 0;
  while ((most - least) >>> shift > 0xffff) shift++;
  const starts = new Uint32Array(0x10001);
  const keyOf = (i) => 0xffff - ((bits[i] - least) >>> shift);
  let drawn = 0;
  for (let i = 0; i < count; i++) {
    if (bits[i] === 0) continue;
    starts[keyOf(i) + 1]++;
    drawn++;
  }
  for (let key = 0; key < 0x10000; key++) starts[key + 1] += starts[key];
  const order = new Uint32Array(drawn);
  // Backwards, so that at equal depth the earlier splat is drawn over the later one.
  for (let i = count - 1; i >= 0; i--) {
    if (bits[i] !== 0) order[starts[keyOf(i)]++] = i;
  }
  return order;
}

/** Sorts in a worker, one request at a time; only the newest waiting request is kept. */
class Sorter {
  constructor(positions, onOrder) {
    this.onOrder = onOrder;
    this.busy = false;
    this.waiting = null;
    this.last = "";
    const source = `${sortByDepth}
      let positions;
      onmessage = ({ data }) => {
        if (data.positions) { positions = data.positions; return; }
        const order = sortByDepth(positions, data.axis, data.offset, data.near);
        postMessage(order, [order.buffer]);
      };`;
    try {
      this.address = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
      this.worker = new Worker(this.address);
      this.worker.onmessage = ({ data }) => this.finish(data);
      this.worker.onerror = () => this.withoutWorker();
      this.worker.postMessage({ positions });
    } catch {
      this.worker = null;
    }
    this.positions = positions;
  }

  request(axis, offset, near) {
    const key = [...axis, offset].join();
    if (key === this.last) return;
    this.last = key;
    this.waiting = { axis, offset, near };
    if (!this.busy) this.start();
  }

  /** Terminates the worker. */
  stop() {
    this.worker?.terminate();
    URL.revokeObjectURL(this.address);
    this.onOrder = () => {};
  }

  get settled() {
    return !this.busy && !this.waiting;
  }

  start() {
    this.asked = this.waiting;
    this.waiting = null;
    this.busy = true;
    if (this.worker) this.worker.postMessage(this.asked);
    else setTimeout(() => this.sortHere(), 0);
  }

  /** Sorts on the page, since some browsers allow no worker for local files. */
  withoutWorker() {
    this.worker = null;
    if (this.busy) this.sortHere();
  }

  sortHere() {
    const { axis, offset, near } = this.asked;
    this.finish(sortByDepth(this.positions, axis, offset, near));
  }

  finish(order) {
    this.busy = false;
    this.onOrder(order);
    if (this.waiting) this.start();
  }
}
