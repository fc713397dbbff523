/** The voltage profile, and the past of what is selected. */

import { byId, colour } from "./format.js";
import { spanOf } from "./layout.js";

/** @typedef {import("./types.js").Grid} Grid @typedef {import("./types.js").Moment} Moment */

const uPlot = /** @type {any} */ (window).uPlot;
const SIGMAS = 3; // of the band around an estimate
const HEIGHT = 260;
const PAST_HEIGHT = 200;
const DOT = 5; // pixels of a bus of the profile; a third of it where there are very many
const MOST_DOTS = 1500;

/** @param {string} label */
function axis(label) {
  const line = { stroke: () => colour("--line"), width: 1 };
  return { label, stroke: () => colour("--ink"), grid: line, ticks: line };
}

/**
 * An axis fits what it shows, where uPlot would begin at 0.
 * @param {number[]} also values that are on it in any case
 * @returns {{range: (chart: any, low: number | null, high: number | null) => [number, number]}}
 */
function fitted(...also) {
  return { range: (_, low, high) => (also.length ? spanOf(Math.min(low ?? Infinity, ...also), Math.max(high ?? -Infinity, ...also)) : spanOf(low, high)) };
}

export class Profile {
  /** @param {Grid} grid */
  constructor(grid) {
    this.holder = byId("profile");
    this.holder.replaceChildren();
    this.grid = grid;
    const known = grid.buses.id.map((_, k) => k).filter((k) => grid.buses.distance[k] !== null);
    this.order = known.sort((a, b) => /** @type {number} */ (grid.buses.distance[a]) - /** @type {number} */ (grid.buses.distance[b]));
    this.x = this.order.map((k) => /** @type {number} */ (grid.buses.distance[k]));
    /** @type {(number | null)[]} */ this.sigma = [];
    this.chart = new uPlot({
      width: this.holder.clientWidth || 600,
      height: HEIGHT,
      scales: { x: { time: false }, y: fitted(...grid.limits) },
      axes: [axis(grid.axis), axis("voltage (p.u.)")],
      cursor: { show: false },
      series: [{}, { paths: () => null, points: { show: false } }],
      hooks: { draw: [(/** @type {any} */ chart) => this.drawLimits(chart), (/** @type {any} */ chart) => this.drawBuses(chart)] },
    }, [this.x, this.x.map(() => null)], this.holder);
    this.observer = new ResizeObserver(() => this.chart.setSize({ width: this.holder.clientWidth, height: HEIGHT }));
    this.observer.observe(this.holder);
  }

  /** @param {Moment} moment */
  show(moment) {
    const ids = moment.buses.id ?? [], row = new Map(ids.map((id, k) => [id, k]));
    const [vm, sigma] = ["vm_pu", "sigma_vm_pu"].map((name) =>
      this.order.map((k) => {
        const found = row.get(this.grid.buses.id[k]);
        return found === undefined ? null : /** @type {number | null} */ (moment.buses[name][found]);
      }));
    this.sigma = sigma;
    this.chart.setData([this.x, vm]);
  }

  /** @param {any} chart */
  drawLimits(chart) {
    const { ctx: context, bbox } = chart;
    context.save();
    context.strokeStyle = colour("--bad");
    context.lineWidth = 1.5 * uPlot.pxRatio;
    context.setLineDash([6 * uPlot.pxRatio, 4 * uPlot.pxRatio]);
    context.beginPath();
    for (const limit of this.grid.limits) {
      const at = chart.valToPos(limit, "y", true);
      context.moveTo(bbox.left, at);
      context.lineTo(bbox.left + bbox.width, at);
    }
    context.stroke();
    context.restore();
  }

  /** A dot for each bus, and a bar of three standard deviations to either side. @param {any} chart */
  drawBuses(chart) {
    const context = chart.ctx, vm = chart.data[1], size = (this.x.length > MOST_DOTS ? DOT / 3 : DOT) * uPlot.pxRatio;
    context.save();
    context.strokeStyle = context.fillStyle = colour("--mark");
    context.lineWidth = uPlot.pxRatio;
    context.beginPath();
    this.x.forEach((x, k) => {
      if (vm[k] === null) return;
      const sigma = this.sigma[k] ?? 0, at = chart.valToPos(x, "x", true);
      context.moveTo(at, chart.valToPos(vm[k] - SIGMAS * sigma, "y", true));
      context.lineTo(at, chart.valToPos(vm[k] + SIGMAS * sigma, "y", true));
      context.fillRect(at - size / 2, chart.valToPos(vm[k], "y", true) - size / 2, size, size);
    });
    context.stroke();
    context.restore();
  }

  /** In the colours that hold now. */
  repaint() {
    this.chart.redraw(false);
  }

  /** Give back what the browser keeps for it. */
  destroy() {
    this.observer.disconnect();
    this.chart.destroy();
  }
}

const SHOWN = {
  bus: ["vm_pu", "voltage (p.u.)"],
  branch: ["p_from_kw", "active power (kW)"],
  meter: ["reading", "reading, dashed: estimate"],
  area: ["quality", "quality (0 is good)"],
};

/** The past of what is chosen: one chart that lives as long as the choice. */
export class Past {
  constructor() {
    this.holder = byId("past");
    this.of = "";
    /** @type {any} */ this.chart = null;
    new ResizeObserver(() => this.chart?.setSize({ width: this.holder.clientWidth, height: PAST_HEIGHT })).observe(this.holder);
  }

  /** In the colours that hold now. */
  repaint() {
    this.chart?.redraw(false);
  }

  /** Show nothing. */
  clear() {
    this.chart?.destroy(); // else the browser keeps it, and its listeners, for ever
    this.chart = null;
    this.of = "";
  }

  /** @param {"bus"|"branch"|"meter"|"area"} kind @param {string} id @param {{time: number[], columns: Record<string, (number | null)[]>}} past @param {boolean} ofDay */
  show(kind, id, past, ofDay) {
    if (!past.time.length) return this.clear();
    const series = kind === "meter" ? [past.columns.reading, past.columns.estimate] : [past.columns[SHOWN[kind][0]]];
    if (this.of === `${kind} ${id}`) return this.chart.setData([past.time, ...series]);
    this.clear();
    this.of = `${kind} ${id}`;
    const styles = [{ stroke: () => colour("--mark"), width: 1.5 }, { stroke: () => colour("--good"), width: 1.5, dash: [4, 3] }];
    this.chart = new uPlot({
      width: this.holder.clientWidth || 300,
      height: PAST_HEIGHT,
      scales: { x: { time: ofDay }, y: fitted() },
      axes: [axis(""), { ...axis(SHOWN[kind][1]), size: 64 }],
      cursor: { show: false },
      series: [{}, ...styles.slice(0, series.length)],
    }, [past.time, ...series], this.holder);
  }
}
