/** The feeder: what is shown of it, zoomed and chosen there. `painter.js` paints it, on a thread of its own. */

import { colour } from "./format.js";
import { placeBuses } from "./layout.js";
import { findStructure, paintFeeder } from "./paint.js";

/** @typedef {import("./types.js").Grid} Grid @typedef {import("./types.js").Moment} Moment */
/** @typedef {import("./types.js").Choice} Choice @typedef {import("./types.js").Painting} Painting */
/** @typedef {import("./types.js").Palette} Palette @typedef {import("./types.js").PaintedMoment} PaintedMoment */

const d3 = /** @type {any} */ (window).d3;
const NEAR = 14; // pixels within which a click finds a bus
const STEPS = 32; // of voltage
const INKS = ["--ink", "--faint", "--line", "--good", "--degraded", "--bad", "--mark"];

/** Of voltages from low to high: even steps of lightness, as in pictures. @returns {Palette} */
function readPalette() {
  return {
    colours: Object.fromEntries(INKS.map((name) => [name, colour(name)])),
    areas: [...d3.schemeTableau10],
    voltages: Array.from({ length: STEPS }, (_, k) => d3.interpolateViridis(0.1 + (0.82 * k) / (STEPS - 1))),
  };
}

/** @param {Moment} moment @returns {PaintedMoment} as much of it as is painted */
function pickPainted(moment) {
  return {
    qualities: Object.fromEntries(Object.entries(moment.view.areas).map(([name, area]) => [name, area.quality])),
    bus: /** @type {number[]} */ (moment.buses.id ?? []),
    vm: /** @type {(number | null)[]} */ (moment.buses.vm_pu ?? []),
    loading: /** @type {(number | null)[]} */ (moment.branches.loading_percent ?? []),
    links: moment.links,
    messages: moment.messages,
  };
}

export class Feeder {
  /** @param {HTMLCanvasElement} canvas @param {HTMLCanvasElement} print @param {(choice: Choice) => void} onChoose */
  constructor(canvas, print, onChoose) {
    this.canvas = canvas;
    this.print = print;
    this.onChoose = onChoose;
    this.painter = new Worker("/static/painter.js", { type: "module" });
    const surface = canvas.transferControlToOffscreen();
    this.painter.postMessage({ canvas: surface, changed: {} }, [surface]);
    /** @type {Partial<Painting>} */ this.painting = {};
    /** @type {Partial<Painting>} */ this.changed = {};
    this.planned = 0;
    this.transform = d3.zoomIdentity;
    this.zoom = d3.zoom().scaleExtent([0.5, 60]).on("zoom", (/** @type {any} */ event) => {
      this.transform = event.transform;
      this.fit();
    });
    d3.select(canvas).call(this.zoom).on("dblclick.zoom", null);
    canvas.addEventListener("click", (event) => this.choose(event));
    new ResizeObserver(() => this.fit()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.change({ palette: readPalette() }));
    this.change({ palette: readPalette(), moment: null, choice: null });
  }

  /** @param {Grid} grid */
  setGrid(grid) {
    this.change({ grid, moment: null }); // the moment may be about another grid
    this.fit();
  }

  /** @param {Moment} moment */
  show(moment) {
    this.change({ moment: pickPainted(moment) });
  }

  /** @param {Choice | null} choice */
  mark(choice) {
    this.change({ choice });
  }

  /** The whole feeder again. */
  reset() {
    d3.select(this.canvas).call(this.zoom.transform, d3.zoomIdentity);
  }

  fit() {
    const { k, x, y } = this.transform;
    this.change({
      view: {
        width: this.canvas.clientWidth, height: this.canvas.clientHeight, ratio: window.devicePixelRatio || 1, transform: { k, x, y },
      },
    });
  }

  /** Send what has changed once, with the next picture, however often it does. @param {Partial<Painting>} changed */
  change(changed) {
    Object.assign(this.painting, changed);
    Object.assign(this.changed, changed);
    this.planned ||= requestAnimationFrame(() => {
      this.planned = 0;
      this.painter.postMessage({ changed: this.changed });
      this.changed = {};
    });
  }

  /** Paint for a printer, which does not wait for another thread. */
  paintPrint() {
    const { grid, view } = this.painting;
    if (!grid || !view) return;
    const painting = { .../** @type {Painting} */ (this.painting), view: { ...view, ratio: 2 }, palette: readPalette() };
    paintFeeder(this.print, painting, findStructure(grid));
  }

  /** @param {MouseEvent} event */
  choose(event) {
    const { grid, view } = this.painting, box = this.canvas.getBoundingClientRect();
    if (!grid || !view) return;
    const points = placeBuses(grid, view).map((point, k) => [...point, k]);
    const found = d3.quadtree(points).find(event.clientX - box.left, event.clientY - box.top, NEAR);
    if (found) this.onChoose({ kind: "bus", id: String(grid.buses.id[found[2]]) });
  }
}
