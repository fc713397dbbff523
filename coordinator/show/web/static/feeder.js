/** The feeder: what is shown of it, zoomed and chosen there. `painter.js` paints it, on a thread of its own. */

import { byId, colour, number } from "./format.js";
import { edgesOf, heightOf, placeBuses } from "./layout.js";
import { findDeadLinks } from "./links.js";
import { freshBranches, largestLoadings, worstVoltages } from "./phases.js";
import { findStructure, paintFeeder } from "./paint.js";

/** @typedef {import("./types.js").Grid} Grid @typedef {import("./types.js").Moment} Moment */
/** @typedef {import("./types.js").Choice} Choice @typedef {import("./types.js").Painting} Painting */
/** @typedef {import("./types.js").Palette} Palette @typedef {import("./types.js").PaintedMoment} PaintedMoment */

const d3 = /** @type {any} */ (window).d3;
const NEAR = 14; // pixels within which a click finds a bus
const STEPS = 10; // of voltage
const INKS = ["--paper", "--ink", "--faint", "--line", "--good", "--degraded", "--bad", "--mark", "--shade-degraded", "--shade-bad"];
const CALM = [0, 3, 6, 4, 8, 9]; // of Tableau's ten colours, those that nobody takes for an alarm

/** Of voltages: a step each, low ones violet, high ones brown, pale about the nominal one; red is left to what is wrong. @returns {Palette} */
function readPalette() {
  return {
    colours: Object.fromEntries(INKS.map((name) => [name, colour(name)])),
    areas: CALM.map((k) => d3.schemeTableau10[k]),
    voltages: d3.schemePuOr[STEPS],
  };
}

/** The steps of voltage in the legend. @param {Palette} palette @param {import("./types.js").Limits} limits */
function paintScale({ voltages }, limits) {
  const edges = edgesOf(limits), wide = 100 / voltages.length;
  byId("voltages").replaceChildren(...voltages.map((ink, k) => {
    const step = document.createElementNS("http://www.w3.org/2000/svg", "rect");
    for (const [name, value] of Object.entries({ x: k * wide, y: 0, width: wide, height: 12, fill: ink })) step.setAttribute(name, String(value));
    return step;
  }));
  byId("lowest").textContent = number(edges[0], 4);
  byId("scale").textContent = `${number(edges[edges.length - 1], 4)} p.u., ${number(edges[1] - edges[0], 3)} a step`;
}

/** One finger scrolls the page, or nobody would get past the drawing on a phone. @param {any} event @returns {boolean} */
function mayZoom(event) {
  return event.type === "touchstart" ? event.touches.length > 1 : !event.button && (!event.ctrlKey || event.type === "wheel");
}

/** @param {Moment} moment @param {Grid} grid @returns {PaintedMoment} as much of it as is painted */
function pickPainted(moment, grid) {
  return {
    qualities: Object.fromEntries(Object.entries(moment.view.areas).map(([name, area]) => [name, area.quality])),
    worst: worstVoltages(grid, moment),
    loading: largestLoadings(grid, moment.branches),
    freshBranches: freshBranches(grid, moment.branches),
    switches: Object.assign({}, ...Object.values(moment.view.areas).map((area) => area.switches)),
    cause: moment.causes[0] ?? null,
    links: moment.links,
    dead: findDeadLinks(moment),
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
    this.zoom = d3.zoom().scaleExtent([0.5, 60]).filter(mayZoom).on("zoom", (/** @type {any} */ event) => {
      this.transform = event.transform;
      this.fit();
    });
    d3.select(canvas).call(this.zoom).on("dblclick.zoom", null);
    canvas.addEventListener("click", (event) => this.choose(event));
    new ResizeObserver(() => this.fit()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.repaint());
    this.change({ moment: null, choice: null });
    this.repaint();
  }

  /** In the colours that hold now. */
  repaint() {
    const palette = readPalette();
    if (this.painting.grid) paintScale(palette, this.painting.grid.operating_limits);
    this.change({ palette });
  }

  /** @param {Grid} grid */
  setGrid(grid) {
    this.change({ grid, moment: null }); // the moment may be about another grid
    this.canvas.style.height = `${heightOf(grid)}px`;
    paintScale(readPalette(), grid.operating_limits);
    this.fit();
  }

  /** @param {Moment} moment */
  show(moment) {
    if (this.painting.grid) this.change({ moment: pickPainted(moment, this.painting.grid) });
  }

  /** @param {Choice | null} choice */
  mark(choice) {
    this.change({ choice });
  }

  /** The whole feeder again. */
  reset() {
    d3.select(this.canvas).call(this.zoom.transform, d3.zoomIdentity);
  }

  /** Nearer or farther, by `factor`; what is chosen comes to the middle. @param {number} factor */
  scale(factor) {
    const { grid, view, choice } = this.painting, row = choice?.kind === "bus" && grid ? grid.buses.id.indexOf(Number(choice.id)) : -1;
    const surface = d3.select(this.canvas);
    if (grid && view && row >= 0 && factor > 1) {
      const [x, y] = placeBuses(grid, { ...view, transform: { k: 1, x: 0, y: 0 } })[row];
      surface.call(this.zoom.translateTo, x, y);
    }
    surface.call(this.zoom.scaleBy, factor);
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
    const palette = readPalette(), painting = { .../** @type {Painting} */ (this.painting), view: { ...view, ratio: 2 }, palette };
    paintScale(palette, grid.operating_limits);
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
