/** The voltage profile, and what all charts have in common. */

import { byId, colour, number } from "./format.js";
import { spanOf } from "./layout.js";

/** @typedef {import("./types.js").Grid} Grid @typedef {import("./types.js").Moment} Moment */

const uPlot = /** @type {any} */ (window).uPlot;
const SIGMAS = 3; // of the band around an estimate
const HEIGHT = 260;
const DOT = 5; // pixels of a bus of the profile; a third of it where there are very many
const MOST_DOTS = 1500;

/** @param {string} label */
export function axis(label) {
  const line = { stroke: () => colour("--line"), width: 1 };
  return { label, stroke: () => colour("--ink"), grid: line, ticks: line };
}

/** Ticks that differ are written differently, where uPlot rounds to thousandths. @param {string} label */
export function valueAxis(label) {
  return { ...axis(label), values: (/** @type {any} */ _, /** @type {number[]} */ ticks) => ticks.map((tick) => number(tick, 7)) };
}

/**
 * An axis fits what it shows, where uPlot would begin at 0.
 * @param {number[]} also values that are on it in any case
 * @returns {{range: (chart: any, low: number | null, high: number | null) => [number, number]}}
 */
export function fitted(...also) {
  return { range: (_, low, high) => (also.length ? spanOf(Math.min(low ?? Infinity, ...also), Math.max(high ?? -Infinity, ...also)) : spanOf(low, high)) };
}

export class Profile {
  /** @param {Grid} grid */
  constructor(grid) {
    this.holder = byId("profile");
    this.holder.replaceChildren();
    this.limits = [grid.operating_limits.lowest_vm_pu, grid.operating_limits.highest_vm_pu];
    const known = grid.buses.id.map((_, k) => k).filter((k) => grid.buses.distance[k] !== null);
    this.order = known.sort((a, b) => /** @type {number} */ (grid.buses.distance[a]) - /** @type {number} */ (grid.buses.distance[b]));
    this.areas = this.order.map((k) => grid.buses.area[k]);
    this.x = this.order.map((k) => /** @type {number} */ (grid.buses.distance[k]));
    const place = new Map(this.order.map((k, n) => [grid.buses.id[k], n])), { branches } = grid;
    /** @type {[number, number][]} */ this.lines = branches.id.flatMap((_, k) => { // branches in service, by the places of their ends
      const from = place.get(branches.from_bus[k]), to = place.get(branches.to_bus[k]);
      return branches.in_service[k] && from !== undefined && to !== undefined ? [[from, to]] : [];
    });
    /** @type {(number | null)[]} */ this.sigma = [];
    /** @type {Set<string>} */ this.poor = new Set(); // areas that are not good
    this.chart = new uPlot({
      width: this.holder.clientWidth || 600,
      height: HEIGHT,
      scales: { x: { time: false }, y: fitted(...this.limits) },
      axes: [axis(grid.axis), valueAxis("voltage (p.u.)")],
      cursor: { show: false },
      series: [{}, { paths: () => null, points: { show: false } }],
      hooks: { draw: [(/** @type {any} */ chart) => this.drawLimits(chart), (/** @type {any} */ chart) => this.drawBuses(chart)] },
    }, [this.x, this.x.map(() => null)], this.holder);
    this.observer = new ResizeObserver(() => this.chart.setSize({ width: this.holder.clientWidth, height: HEIGHT }));
    this.observer.observe(this.holder);
  }

  /** A gap where a value is not fresh. @param {Moment} moment */
  show(moment) {
    const [vm, sigma] = ["vm_pu", "sigma_vm_pu"].map((name) =>
      this.order.map((k) => /** @type {number | null} */ (moment.buses.fresh?.[k] === false ? null : moment.buses[name]?.[k] ?? null)));
    this.sigma = sigma;
    this.poor = new Set(Object.entries(moment.view.areas).flatMap(([name, area]) => (area.quality === "good" ? [] : [name])));
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
    for (const limit of this.limits) {
      const at = chart.valToPos(limit, "y", true);
      context.moveTo(bbox.left, at);
      context.lineTo(bbox.left + bbox.width, at);
    }
    context.stroke();
    context.restore();
  }

  /** A line for each branch; for each bus a dot, and a bar of three standard deviations to either side. @param {any} chart */
  drawBuses(chart) {
    const context = chart.ctx, vm = chart.data[1], size = (this.x.length > MOST_DOTS ? DOT / 3 : DOT) * uPlot.pxRatio;
    const [low, high] = this.limits;
    const x = this.x.map((value) => chart.valToPos(value, "x", true)), y = vm.map((/** @type {number | null} */ value) => value === null ? null : chart.valToPos(value, "y", true));
    context.save();
    context.lineWidth = uPlot.pxRatio;
    context.strokeStyle = colour("--faint");
    context.beginPath();
    for (const [from, to] of this.lines) {
      if (y[from] === null || y[to] === null) continue;
      context.moveTo(x[from], y[from]);
      context.lineTo(x[to], y[to]);
    }
    context.stroke();
    const inks = x.map((_, k) => (vm[k] < low || vm[k] > high ? "--bad" : this.poor.has(this.areas[k]) ? "--degraded" : "--mark"));
    for (const [ink, side] of /** @type {[string, number][]} */ ([["--mark", size], ["--degraded", size], ["--bad", 1.6 * size]])) {
      context.strokeStyle = context.fillStyle = colour(ink);
      context.beginPath();
      x.forEach((at, k) => {
        if (y[k] === null || inks[k] !== ink) return;
        const sigma = this.sigma[k] ?? 0;
        context.moveTo(at, chart.valToPos(vm[k] - SIGMAS * sigma, "y", true));
        context.lineTo(at, chart.valToPos(vm[k] + SIGMAS * sigma, "y", true));
        context.fillRect(at - side / 2, y[k] - side / 2, side, side);
      });
      context.stroke();
    }
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
