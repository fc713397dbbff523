/** The feeder on a canvas: buses by voltage, branches by loading, areas as regions, links alive or dead, messages. */

/** @typedef {import("./types.js").Grid} Grid @typedef {import("./types.js").Moment} Moment */
/** @typedef {import("./types.js").Choice} Choice */

const d3 = /** @type {any} */ (window).d3;
const MARGIN = 30; // pixels around the whole feeder
const NEAR = 14; // pixels within which a click finds a bus
const MOST_NUMBERED = 150; // buses on the canvas that get their numbers
const FULL_LOADING = 100; // percent

export class Feeder {
  /** @param {HTMLCanvasElement} canvas @param {(choice: Choice) => void} onChoose */
  constructor(canvas, onChoose) {
    this.canvas = canvas;
    this.onChoose = onChoose;
    /** @type {Grid | null} */ this.grid = null;
    /** @type {Moment | null} */ this.moment = null;
    /** @type {Choice | null} */ this.choice = null;
    /** @type {Map<number, number>} */ this.row = new Map();
    this.transform = d3.zoomIdentity;
    this.zoom = d3.zoom().scaleExtent([0.5, 60]).on("zoom", (/** @type {any} */ event) => {
      this.transform = event.transform;
      this.draw();
    });
    d3.select(canvas).call(this.zoom).on("dblclick.zoom", null);
    canvas.addEventListener("click", (event) => this.choose(event));
    new ResizeObserver(() => this.fit()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  /** @param {Grid} grid */
  setGrid(grid) {
    this.grid = grid;
    this.row = new Map(grid.buses.id.map((bus, k) => [bus, k]));
    this.branchRow = new Map(grid.branches.id.map((branch, k) => [branch, k]));
    this.fit();
  }

  /** @param {Moment} moment */
  show(moment) {
    this.moment = moment;
    this.draw();
  }

  /** @param {Choice | null} choice */
  mark(choice) {
    this.choice = choice;
    this.draw();
  }

  /** The whole feeder again. */
  reset() {
    d3.select(this.canvas).call(this.zoom.transform, d3.zoomIdentity);
  }

  fit() {
    const ratio = window.devicePixelRatio || 1;
    this.width = this.canvas.clientWidth;
    this.height = this.canvas.clientHeight;
    this.canvas.width = this.width * ratio;
    this.canvas.height = this.height * ratio;
    this.draw();
  }

  /** Scales of the whole feeder to pixels. */
  place() {
    const { x, y } = /** @type {Grid} */ (this.grid).buses;
    const [left, right] = d3.extent(x), [top, bottom] = d3.extent(y);
    const across = d3.scaleLinear([left ?? 0, Math.max(right ?? 1, (left ?? 0) + 1)], [MARGIN, this.width - MARGIN]);
    const down = d3.scaleLinear([top ?? 0, Math.max(bottom ?? 1, (top ?? 0) + 1)], [MARGIN, this.height - MARGIN]);
    return x.map((value, k) => this.transform.apply([across(value), down(y[k])]));
  }

  draw() {
    const context = this.canvas.getContext("2d");
    if (!this.grid || !context || !this.width) return;
    const ratio = window.devicePixelRatio || 1, style = getComputedStyle(document.documentElement);
    this.colour = (/** @type {string} */ name) => style.getPropertyValue(name).trim();
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, this.width, this.height);
    const at = this.place();
    this.points = at;
    this.drawAreas(context, at);
    this.drawBranches(context, at);
    this.drawBuses(context, at);
    this.drawLinks(context, at);
  }

  /** @param {CanvasRenderingContext2D} context @param {[number, number][]} at */
  drawAreas(context, at) {
    const grid = /** @type {Grid} */ (this.grid), areas = this.moment?.view.areas ?? {};
    context.font = "600 12px system-ui, sans-serif";
    grid.areas.forEach((area, k) => {
      const points = area.buses.map((bus) => at[/** @type {number} */ (this.row.get(bus))]).filter(Boolean);
      const hull = points.length > 2 ? d3.polygonHull(points) ?? points : points;
      if (!hull.length) return;
      context.beginPath();
      hull.forEach(([x, y], /** @type {number} */ i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
      context.closePath();
      context.fillStyle = context.strokeStyle = d3.schemeTableau10[k % 10];
      context.lineJoin = "round";
      context.globalAlpha = 0.13;
      context.lineWidth = 22;
      context.stroke();
      context.fill();
      context.globalAlpha = 1;
      const [x, y] = [d3.mean(points, (/** @type {number[]} */ p) => p[0]), d3.min(points, (/** @type {number[]} */ p) => p[1])];
      const quality = areas[area.name]?.quality ?? "none";
      context.fillStyle = this.colour(quality === "good" ? "--good" : quality === "degraded" ? "--degraded" : "--bad");
      context.textAlign = "center";
      context.fillText(`${area.name}: ${quality}`.slice(0, 40), x, Math.max(12, y - 14));
    });
  }

  /** @param {CanvasRenderingContext2D} context @param {[number, number][]} at */
  drawBranches(context, at) {
    const { branches } = /** @type {Grid} */ (this.grid), loading = this.moment?.branches.loading_percent ?? [];
    branches.id.forEach((id, k) => {
      const from = at[/** @type {number} */ (this.row.get(branches.from_bus[k]))];
      const to = at[/** @type {number} */ (this.row.get(branches.to_bus[k]))];
      const chosen = this.choice?.kind === "branch" && this.choice.id === id;
      const percent = /** @type {number | null} */ (loading[k]);
      context.beginPath();
      context.setLineDash(branches.in_service[k] ? [] : [4, 4]);
      context.moveTo(from[0], from[1]);
      context.lineTo(to[0], to[1]);
      context.lineWidth = chosen ? 5 : percent ? 1.5 + 2.5 * Math.min(1, percent / FULL_LOADING) : 1.5;
      context.strokeStyle = chosen ? this.colour("--mark") : percent && percent > FULL_LOADING ? this.colour("--bad") : this.colour("--faint");
      context.stroke();
    });
    context.setLineDash([]);
  }

  /** @param {CanvasRenderingContext2D} context @param {[number, number][]} at */
  drawBuses(context, at) {
    const grid = /** @type {Grid} */ (this.grid), ids = this.moment?.buses.id ?? [];
    const vm = new Map(ids.map((id, k) => [id, /** @type {number | null} */ (this.moment?.buses.vm_pu[k])]));
    const scale = voltageScale(grid.limits);
    const size = grid.buses.id.length > 1500 ? 2.5 : grid.buses.id.length > 300 ? 3.5 : 5;
    const inside = at.filter(([x, y]) => x > 0 && y > 0 && x < this.width && y < this.height).length;
    context.font = "11px system-ui, sans-serif";
    context.textAlign = "center";
    grid.buses.id.forEach((bus, k) => {
      const [x, y] = at[k], value = vm.get(bus);
      if (x < -9 || y < -9 || x > this.width + 9 || y > this.height + 9) return;
      const chosen = this.choice?.kind === "bus" && this.choice.id === String(bus);
      context.beginPath();
      context.arc(x, y, chosen ? size + 4 : size, 0, 2 * Math.PI);
      context.fillStyle = value === null || value === undefined ? this.colour("--line") : scale(value);
      context.fill();
      const outside = value != null && (value < grid.limits[0] || value > grid.limits[1]);
      if (chosen || outside || grid.buses.areas[k].length > 1) {
        context.lineWidth = chosen ? 3 : 2;
        context.strokeStyle = this.colour(chosen ? "--mark" : outside ? "--bad" : "--ink");
        context.stroke();
      }
      if (inside <= MOST_NUMBERED) {
        context.fillStyle = this.colour("--ink");
        context.fillText(String(bus), x, y + size + 12);
      }
    });
  }

  /** Links between areas cross where they meet; messages are dots on their way. @param {CanvasRenderingContext2D} context @param {[number, number][]} at */
  drawLinks(context, at) {
    const grid = /** @type {Grid} */ (this.grid), centre = new Map();
    for (const area of grid.areas) {
      const points = area.buses.map((bus) => at[/** @type {number} */ (this.row.get(bus))]).filter(Boolean);
      centre.set(area.name, [d3.mean(points, (/** @type {number[]} */ p) => p[0]), d3.mean(points, (/** @type {number[]} */ p) => p[1])]);
    }
    const boundary = new Map(grid.areas.flatMap((a) => a.neighbours.map((n) => [`${a.name} ${n.area}`, n.bus])));
    for (const link of this.moment?.links ?? []) {
      const bus = boundary.get(`${link.to} ${link.from}`), point = bus === undefined ? null : at[/** @type {number} */ (this.row.get(bus))];
      if (!point || link.alive) continue;
      context.strokeStyle = this.colour("--bad");
      context.lineWidth = 3;
      context.beginPath();
      context.moveTo(point[0] - 8, point[1] - 8);
      context.lineTo(point[0] + 8, point[1] + 8);
      context.moveTo(point[0] + 8, point[1] - 8);
      context.lineTo(point[0] - 8, point[1] + 8);
      context.stroke();
    }
    for (const message of this.moment?.messages ?? []) {
      const from = centre.get(message.from), to = centre.get(message.to);
      if (!from || !to) continue;
      const way = message.lost ? 0.5 : message.arrived === null ? 0.35 : 0.85;
      const x = from[0] + way * (to[0] - from[0]), y = from[1] + way * (to[1] - from[1]);
      context.strokeStyle = this.colour(message.lost ? "--bad" : "--mark");
      context.lineWidth = 1;
      context.beginPath();
      context.moveTo(from[0], from[1]);
      context.lineTo(to[0], to[1]);
      context.stroke();
      context.fillStyle = context.strokeStyle;
      context.beginPath();
      context.arc(x, y, 7, 0, 2 * Math.PI);
      context.fill();
      context.fillStyle = this.colour("--ink");
      context.font = "600 11px system-ui, sans-serif";
      context.fillText(message.lost ? `${message.kind} lost` : message.kind, x, y - 10);
    }
  }

  /** @param {MouseEvent} event */
  choose(event) {
    if (!this.grid || !this.points) return;
    const box = this.canvas.getBoundingClientRect(), x = event.clientX - box.left, y = event.clientY - box.top;
    const tree = d3.quadtree(this.points.map((p, k) => [...p, k]));
    const found = tree.find(x, y, NEAR);
    if (found) this.onChoose({ kind: "bus", id: String(this.grid.buses.id[found[2]]) });
  }
}

/** Colours of voltages: the same even steps of lightness as in pictures. @param {[number, number]} limits */
export function voltageScale(limits) {
  return d3.scaleSequential(limits, (/** @type {number} */ t) => d3.interpolateViridis(0.1 + 0.82 * t)).clamp(true);
}
