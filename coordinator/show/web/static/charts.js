/** The voltage profile, and what all charts have in common. */

import { byId, colour, element, number } from "./format.js";
import { spanOf } from "./layout.js";
import { ALL, joinNodes, lookOf, nodesOf, traceShape } from "./phases.js";

/** @typedef {import("./types.js").Grid} Grid @typedef {import("./types.js").Moment} Moment */

const uPlot = /** @type {any} */ (window).uPlot;
const SIGMAS = 3; // of the band around an estimate
const HEIGHT = 260;
const DOT = 5; // pixels of a bus of the profile; a third of it where there are very many
const MOST_DOTS = 1500;
const LABEL = 12; // pixels of a letter at the end of a line

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

/** The sign of each phase, in its colour. @param {HTMLElement} place @param {string[]} phases in any order, some more than once */
export function showPhases(place, phases) {
  const there = [...new Set(phases)].filter((phase) => phase !== ALL).sort(), text = there.join();
  place.hidden = !there.length;
  if (place.dataset.phases === text) return;
  place.dataset.phases = text;
  place.replaceChildren(...there.map((phase) => {
    const sign = element("span", `${lookOf(phase).sign} ${phase}`);
    sign.style.color = `var(${lookOf(phase).ink})`;
    return sign;
  }));
}

/**
 * The letter of each phase at the end of its line.
 * @param {any} chart @param {{phase: string, x: number, y: number}[]} ends in pixels
 */
export function writeEnds({ ctx: context }, ends) {
  context.font = `600 ${LABEL * uPlot.pxRatio}px system-ui, sans-serif`;
  context.textAlign = "center";
  context.textBaseline = "alphabetic";
  context.lineWidth = 3 * uPlot.pxRatio;
  let above = Infinity; // the last letter, so that none lies on another
  for (const { phase, x, y } of [...ends].sort((one, other) => other.y - one.y)) {
    above = Math.min(y - 7 * uPlot.pxRatio, above - LABEL * uPlot.pxRatio);
    context.strokeStyle = colour("--panel");
    context.strokeText(phase, x, above);
    context.fillStyle = colour(lookOf(phase).ink);
    context.fillText(phase, x, above);
  }
}

/** A point for each node: a bus, or each of its phases. */
export class Profile {
  /** @param {Grid} grid */
  constructor(grid) {
    this.holder = byId("profile");
    this.holder.replaceChildren();
    this.limits = [grid.operating_limits.lowest_vm_pu, grid.operating_limits.highest_vm_pu];
    const nodes = nodesOf(grid), row = new Map(grid.buses.id.map((bus, k) => [bus, k])), of = nodes.bus.map((bus) => row.get(bus) ?? 0);
    const far = (/** @type {number} */ n) => /** @type {number} */ (grid.buses.distance[of[n]]);
    this.order = nodes.bus.map((_, n) => n).filter((n) => grid.buses.distance[of[n]] !== null).sort((a, b) => far(a) - far(b));
    this.areas = this.order.map((n) => grid.buses.area[of[n]]);
    this.phases = this.order.map((n) => nodes.phase[n]);
    this.x = this.order.map(far);
    const place = new Map(this.order.map((n, k) => [n, k]));
    /** @type {[number, number][]} */ this.lines = joinNodes(grid).flatMap(([one, other]) => { // by the places of their ends
      const from = place.get(one), to = place.get(other);
      return from !== undefined && to !== undefined ? [[from, to]] : [];
    });
    showPhases(byId("profile-phases"), this.phases);
    this.holder.setAttribute("aria-label", `Voltage of ${grid.nodes ? "every phase of " : ""}every bus against its distance from the substation`);
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

  /** A line for each branch and phase; for each node a dot, and a bar of three standard deviations to either side. @param {any} chart */
  drawBuses(chart) {
    const context = chart.ctx, vm = chart.data[1], size = (this.x.length > MOST_DOTS ? DOT / 3 : DOT) * uPlot.pxRatio;
    const [low, high] = this.limits;
    const x = this.x.map((value) => chart.valToPos(value, "x", true)), y = vm.map((/** @type {number | null} */ value) => value === null ? null : chart.valToPos(value, "y", true));
    context.save();
    context.lineWidth = uPlot.pxRatio;
    const looks = new Map(this.phases.map((phase) => [phase, lookOf(phase)]));
    for (const [phase, { ink, dash }] of looks) {
      context.strokeStyle = colour(phase === ALL ? "--faint" : ink);
      context.setLineDash(dash.map((length) => length * uPlot.pxRatio));
      context.beginPath();
      for (const [from, to] of this.lines) {
        if (this.phases[to] !== phase || y[from] === null || y[to] === null) continue;
        context.moveTo(x[from], y[from]);
        context.lineTo(x[to], y[to]);
      }
      context.stroke();
    }
    context.setLineDash([]);
    const inks = x.map((_, k) => (vm[k] < low || vm[k] > high ? "--bad" : this.poor.has(this.areas[k]) ? "--degraded" : lookOf(this.phases[k]).ink));
    const own = [...looks.values()].map(({ ink }) => ink);
    for (const ink of [...own, "--degraded", "--bad"]) {
      const side = ink === "--bad" ? 1.6 * size : size, dots = new Path2D();
      context.strokeStyle = context.fillStyle = colour(ink);
      context.beginPath();
      x.forEach((at, k) => {
        if (y[k] === null || inks[k] !== ink) return;
        const sigma = this.sigma[k] ?? 0;
        context.moveTo(at, chart.valToPos(vm[k] - SIGMAS * sigma, "y", true));
        context.lineTo(at, chart.valToPos(vm[k] + SIGMAS * sigma, "y", true));
        traceShape(dots, lookOf(this.phases[k]).shape, at, y[k], side);
      });
      context.stroke();
      context.fill(dots);
    }
    const last = new Map(x.flatMap((at, k) => (y[k] === null || this.phases[k] === ALL ? [] : [[this.phases[k], { phase: this.phases[k], x: at, y: y[k] }]])));
    writeEnds(chart, [...last.values()]);
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
