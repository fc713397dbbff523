/** The voltage profile, and the past of what is selected. */

import { byId } from "./format.js";

/** @typedef {import("./types.js").Grid} Grid @typedef {import("./types.js").Moment} Moment */

const uPlot = /** @type {any} */ (window).uPlot;
const SIGMAS = 3; // of the band around an estimate
const HEIGHT = 260;

/** @param {string} name @returns {string} */
function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

/** @param {string} label */
function axis(label) {
  const line = { stroke: () => colour("--line"), width: 1 };
  return { label, stroke: () => colour("--ink"), grid: line, ticks: line };
}

export class Profile {
  /** @param {Grid} grid */
  constructor(grid) {
    this.holder = byId("profile");
    this.holder.replaceChildren();
    this.grid = grid;
    const known = grid.buses.id.map((_, k) => k).filter((k) => grid.buses.distance[k] !== null);
    this.order = known.sort((a, b) => /** @type {number} */ (grid.buses.distance[a]) - /** @type {number} */ (grid.buses.distance[b]));
    this.x = this.order.map((k) => grid.buses.distance[k]);
    const [low, high] = grid.limits, limit = { stroke: () => colour("--bad"), dash: [6, 4], width: 1.5, points: { show: false } };
    this.chart = new uPlot({
      width: this.holder.clientWidth || 600,
      height: HEIGHT,
      scales: { x: { time: false } },
      axes: [axis(grid.axis), axis("voltage (p.u.)")],
      cursor: { show: false },
      series: [
        {},
        { paths: () => null, points: { show: true, size: 5, fill: () => colour("--mark"), stroke: () => colour("--mark") } },
        limit,
        limit,
      ],
      hooks: { draw: [(/** @type {any} */ chart) => this.drawBands(chart)] },
    }, [this.x, this.x.map(() => null), this.x.map(() => low), this.x.map(() => high)], this.holder);
    /** @type {(number | null)[]} */ this.sigma = [];
    new ResizeObserver(() => this.chart.setSize({ width: this.holder.clientWidth, height: HEIGHT })).observe(this.holder);
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
    const [low, high] = this.grid.limits;
    this.chart.setData([this.x, vm, this.x.map(() => low), this.x.map(() => high)]);
  }

  /** A bar of three standard deviations to either side. @param {any} chart */
  drawBands(chart) {
    const context = chart.ctx, vm = chart.data[1];
    context.save();
    context.strokeStyle = colour("--mark");
    context.lineWidth = 1;
    context.beginPath();
    this.x.forEach((x, k) => {
      const sigma = this.sigma[k];
      if (vm[k] === null || sigma === null || sigma === undefined) return;
      const at = chart.valToPos(x, "x", true);
      context.moveTo(at, chart.valToPos(vm[k] - SIGMAS * sigma, "y", true));
      context.lineTo(at, chart.valToPos(vm[k] + SIGMAS * sigma, "y", true));
    });
    context.stroke();
    context.restore();
  }
}

const SHOWN = {
  bus: ["vm_pu", "voltage (p.u.)"],
  branch: ["p_from_kw", "active power (kW)"],
  meter: ["reading", "reading"],
  area: ["quality", "quality (0 is good)"],
};

/** @param {"bus"|"branch"|"meter"|"area"} kind @param {{time: number[], columns: Record<string, number[]>}} past @param {boolean} ofDay */
export function drawPast(kind, past, ofDay) {
  const holder = byId("past"), [name, label] = SHOWN[kind];
  holder.replaceChildren();
  if (!past.time.length) return;
  const series = kind === "meter" ? [past.columns.reading, past.columns.estimate] : [past.columns[name]];
  const styles = [{ stroke: () => colour("--mark"), width: 1.5 }, { stroke: () => colour("--good"), width: 1.5, dash: [4, 3] }];
  new uPlot({
    width: holder.clientWidth || 300,
    height: 200,
    scales: { x: { time: ofDay } },
    axes: [axis(""), axis(label)],
    cursor: { show: false },
    series: [{}, ...styles.slice(0, series.length)],
  }, [past.time, ...series], holder);
}
