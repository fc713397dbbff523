/** The feeder on a canvas: what is shown, zoomed and chosen there. `paint.js` paints it. */

import { findShapes, fitInto, usualLength } from "./layout.js";
import { paintAreas, paintBranches, paintBuses, paintLinks, paintMessages } from "./paint.js";

/** @typedef {import("./types.js").Grid} Grid @typedef {import("./types.js").Moment} Moment */
/** @typedef {import("./types.js").Choice} Choice @typedef {import("./layout.js").Shape} Shape @typedef {import("./layout.js").Point} Point */

const d3 = /** @type {any} */ (window).d3;
const MARGIN = 34; // pixels around the whole feeder
const NEAR = 14; // pixels within which a click finds a bus

export class Feeder {
  /** @param {HTMLCanvasElement} canvas @param {(choice: Choice) => void} onChoose */
  constructor(canvas, onChoose) {
    this.canvas = canvas;
    this.onChoose = onChoose;
    /** @type {Grid | null} */ this.grid = null;
    /** @type {Moment | null} */ this.moment = null;
    /** @type {Choice | null} */ this.choice = null;
    /** @type {Map<number, number>} */ this.row = new Map();
    /** @type {Shape[]} */ this.shapes = [];
    /** @type {Point[]} */ this.points = [];
    this.width = 0;
    this.height = 0;
    this.planned = 0;
    this.scales = fitInto([], [], 0, 0, MARGIN);
    this.transform = d3.zoomIdentity;
    this.zoom = d3.zoom().scaleExtent([0.5, 60]).on("zoom", (/** @type {any} */ event) => {
      this.transform = event.transform;
      this.plan();
    });
    d3.select(canvas).call(this.zoom).on("dblclick.zoom", null);
    canvas.addEventListener("click", (event) => this.choose(event));
    new ResizeObserver(() => this.fit()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.plan());
    window.addEventListener("beforeprint", () => this.draw());
    window.addEventListener("afterprint", () => this.plan());
  }

  /** @param {Grid} grid */
  setGrid(grid) {
    this.grid = grid;
    this.moment = null; // it may be about another grid
    this.row = new Map(grid.buses.id.map((bus, k) => [bus, k]));
    this.shapes = findShapes(grid);
    this.fit();
  }

  /** @param {Moment} moment */
  show(moment) {
    this.moment = moment;
    this.plan();
  }

  /** @param {Choice | null} choice */
  mark(choice) {
    this.choice = choice;
    this.plan();
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
    const { x, y } = this.grid?.buses ?? { x: [], y: [] };
    this.scales = fitInto(x, y, this.width, this.height, MARGIN);
    this.plan();
  }

  /** Draw once, with the next picture, however often it is asked for. */
  plan() {
    if (this.planned) return;
    this.planned = requestAnimationFrame(() => {
      this.planned = 0;
      this.draw();
    });
  }

  /** @returns {Point[]} of all buses, in pixels */
  place() {
    const { x, y } = /** @type {Grid} */ (this.grid).buses, { kx, ox, ky, oy } = this.scales;
    const { k, x: left, y: top } = this.transform;
    return x.map((value, row) => [k * (kx * value + ox) + left, k * (ky * y[row] + oy) + top]);
  }

  draw() {
    const context = this.canvas.getContext("2d"), { grid, moment, choice } = this;
    if (!grid || !context || !this.width) return;
    const ratio = window.devicePixelRatio || 1, style = getComputedStyle(document.documentElement);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, this.width, this.height);
    const at = (this.points = this.place());
    const canvas = {
      context, grid, moment, choice, at, row: this.row, shapes: this.shapes, width: this.width, height: this.height,
      colour: (/** @type {string} */ name) => style.getPropertyValue(name).trim(),
      spacing: usualLength(at, this.shapes.flatMap((shape) => shape.segments)),
    };
    paintAreas(canvas);
    paintBranches(canvas);
    paintBuses(canvas);
    paintLinks(canvas);
    paintMessages(canvas);
  }

  /** @param {MouseEvent} event */
  choose(event) {
    const box = this.canvas.getBoundingClientRect(), x = event.clientX - box.left, y = event.clientY - box.top;
    const found = d3.quadtree(this.points.map((p, k) => [...p, k])).find(x, y, NEAR);
    if (this.grid && found) this.onChoose({ kind: "bus", id: String(this.grid.buses.id[found[2]]) });
  }
}
