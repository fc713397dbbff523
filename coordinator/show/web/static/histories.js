/** Histories: two quantities side by side over one range of time, of what is chosen or of what is kept there. */

import { axis, fitted, showPhases, valueAxis, writeEnds } from "./charts.js";
import { csvOf, keep } from "./csv.js";
import { byId, clock, colour, element, fixed, labelOf, when } from "./format.js";
import { rangeOf } from "./layout.js";
import { ALL, lookOf } from "./phases.js";

/** @typedef {import("./types.js").Choice} Choice @typedef {import("./types.js").Moment} Moment */
/** @typedef {{time: number[], columns: Record<string, (number | null)[]>, complete: boolean}} Past */

const uPlot = /** @type {any} */ (window).uPlot;
const HEIGHT = 200;
const ASK_MS = 2000; // between two times that the past is asked for
const SIDES = ["Left", "Right"];
/** @type {Record<string, string[][]>} */ const FIRST = { // quantities to begin with, left and right: the first that there is
  bus: [["vm_pu"], ["unbalance_percent", "va_deg"]], branch: [["p_from_kw"], ["neutral_a", "loading_percent"]],
  meter: [["reading"], ["normalised_residual"]], area: [["quality"], ["lowest_vm_pu"]],
};

/** @param {string} column such as vm_pu, or vm_pu.a of a phase @returns {[string, string]} quantity and phase */
function partsOf(column) {
  const [name, phase = ALL] = column.split(".");
  return [name, phase];
}

/** @param {Moment} moment @returns {number} what makes a time of day of its times; 0 where they have none */
function sinceOf(moment) {
  return moment.mode === "live" ? 0 : moment.time - moment.at;
}

/** One of the two charts, which lives as long as what it shows. */
class Side {
  /** @param {string} title @param {number} place @param {Histories} all */
  constructor(title, place, all) {
    this.place = place;
    this.all = all;
    /** @type {Choice | null} */ this.choice = null;
    /** @type {Map<string, string>} */ this.wanted = new Map(); // quantity of each kind
    /** @type {any} */ this.chart = null;
    this.of = "";
    this.names = "";
    this.title = element("h3");
    this.select = document.createElement("select");
    this.select.setAttribute("aria-label", `${title} quantity`);
    this.select.addEventListener("change", () => {
      if (this.choice) this.wanted.set(this.choice.kind, this.select.value);
      all.draw();
    });
    this.kept = document.createElement("input");
    this.kept.type = "checkbox";
    this.kept.setAttribute("aria-label", `${title} stays when something else is chosen`);
    this.kept.addEventListener("change", () => all.choose(all.choice));
    const label = element("label", "Keep ");
    label.append(this.kept);
    this.reading = document.createElement("output");
    this.legend = element("span", "", "phases");
    this.holder = element("div");
    this.box = element("div", "", "side");
    const bar = element("div", "", "bar");
    bar.append(this.title, this.select, label, this.legend, this.reading);
    this.box.append(bar, this.holder);
    new ResizeObserver(() => this.chart?.setSize({ width: this.holder.clientWidth, height: HEIGHT })).observe(this.holder);
  }

  /** @param {Past | undefined} past @param {Moment} moment */
  draw(past, moment) {
    this.title.textContent = this.choice ? `${this.choice.kind} ${this.choice.id}` : "";
    if (!this.choice || !past?.time.length) return this.clear();
    const { kind, id } = this.choice, since = sinceOf(moment), isOfDay = moment.mode === "live" || since > 0;
    const columns = Object.keys(past.columns).filter((column) => kind !== "meter" || column !== "estimate");
    const names = [...new Set(columns.map((column) => partsOf(column)[0]))];
    const usual = FIRST[kind][this.place].find((each) => names.includes(each)) ?? names[0];
    const wanted = this.wanted.get(kind) ?? usual, name = names.includes(wanted) ? wanted : usual, all = names.join(" ");
    if (this.names !== all) {
      this.names = all;
      this.select.replaceChildren(...names.map((each) => new Option(labelOf(each), each)));
    }
    this.select.value = name;
    const shown = name === "reading" ? [name, "estimate"] : columns.filter((column) => partsOf(column)[0] === name);
    const data = [past.time.map((at) => at + since), ...shown.map((each) => past.columns[each])], phases = shown.map((column) => partsOf(column)[1]);
    const of = JSON.stringify([kind, id, shown]);
    if (this.of === of) return this.chart.setData(data);
    this.clear();
    this.of = of;
    showPhases(this.legend, phases);
    const styles = name === "reading" ? [{ stroke: () => colour("--mark"), width: 1.5 }, { stroke: () => colour("--good"), width: 1.5, dash: [4, 3] }]
      : phases.map(lookOf).map(({ ink, dash }) => ({ stroke: () => colour(ink), width: 1.5, dash }));
    const label = name === "reading" ? "reading, dashed: estimate" : name === "quality" ? "quality (0 is good)" : labelOf(name);
    const ticks = { values: (/** @type {any} */ _, /** @type {number[]} */ at) => at.map(clock), space: 70 };
    this.chart = new uPlot({
      width: this.holder.clientWidth || 300,
      height: HEIGHT,
      scales: { x: { time: isOfDay, range: (/** @type {any} */ chart) => rangeOf(chart.data[0], this.all.range) }, y: fitted() },
      axes: [isOfDay ? { ...axis(""), ...ticks } : axis("time (s)"), { ...valueAxis(label), size: 76 }],
      cursor: { sync: { key: "histories" }, y: false, drag: { setScale: false } },
      series: [{}, ...styles],
      hooks: {
        setCursor: [(/** @type {any} */ chart) => this.read(chart, name, phases)],
        setSelect: [(/** @type {any} */ chart) => this.zoom(chart)],
        draw: [(/** @type {any} */ chart) => this.drawMoment(chart), (/** @type {any} */ chart) => this.drawEnds(chart, phases)],
      },
    }, data, this.holder);
  }

  /** What the chart has where the pointer is. @param {any} chart @param {string} name @param {string[]} phases */
  read(chart, name, phases) {
    const k = chart.cursor.idx, { moment } = this.all;
    if (k === null || k === undefined || !moment || !chart.data[0].length) return void (this.reading.textContent = "");
    const values = chart.data.slice(1).map((/** @type {(number|null)[]} */ column) => fixed(column[k], name));
    const said = name === "reading" ? values.join(", estimate ") : phases.map((phase, n) => (phase === ALL ? values[n] : `${phase} ${values[n]}`)).join(", ");
    this.reading.textContent = `${when(moment, chart.data[0][k] - sinceOf(moment))}: ${said}`;
  }

  /** The letter of each phase at the newest value that is shown. @param {any} chart @param {string[]} phases */
  drawEnds(chart, phases) {
    const { left, width } = chart.bbox, [times] = chart.data;
    writeEnds(chart, phases.flatMap((phase, n) => {
      if (phase === ALL) return [];
      const values = chart.data[n + 1], x = (/** @type {number} */ k) => chart.valToPos(times[k], "x", true);
      const k = values.findLastIndex((/** @type {number | null} */ value, /** @type {number} */ at) => value !== null && x(at) <= left + width);
      return k < 0 || x(k) < left ? [] : [{ phase, x: x(k), y: chart.valToPos(values[k], "y", true) }];
    }));
  }

  /** To what was marked with the pointer. @param {any} chart */
  zoom(chart) {
    const { left, width } = chart.select;
    if (width < 2) return;
    const from = chart.posToVal(left, "x"), to = chart.posToVal(left + width, "x");
    chart.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    this.all.show({ length: to - from, end: to });
  }

  /** A line at the moment of a playback. @param {any} chart */
  drawMoment(chart) {
    const { moment } = this.all, { ctx: context, bbox } = chart;
    if (moment?.mode !== "playback") return;
    const x = chart.valToPos(moment.at + sinceOf(moment), "x", true);
    if (x < bbox.left || x > bbox.left + bbox.width) return;
    context.save();
    context.strokeStyle = colour("--ink");
    context.lineWidth = uPlot.pxRatio;
    context.setLineDash([2 * uPlot.pxRatio, 3 * uPlot.pxRatio]);
    context.beginPath();
    context.moveTo(x, bbox.top);
    context.lineTo(x, bbox.top + bbox.height);
    context.stroke();
    context.restore();
  }

  /** Show nothing. */
  clear() {
    this.chart?.destroy(); // else the browser keeps it, and its listeners, for ever
    this.chart = null;
    this.of = "";
    this.reading.textContent = "";
    showPhases(this.legend, []);
  }
}

export class Histories {
  /** @param {(path: string) => Promise<any>} ask */
  constructor(ask) {
    this.ask = ask;
    /** @type {Choice | null} */ this.choice = null;
    /** @type {Moment | null} */ this.moment = null;
    /** @type {import("./layout.js").Range} */ this.range = { length: Infinity, end: null };
    /** @type {Map<string, Past>} */ this.pasts = new Map();
    this.askedAt = -Infinity;
    this.isAsking = false;
    this.sides = SIDES.map((title, k) => new Side(title, k, this));
    byId("past").replaceChildren(...this.sides.map(({ box }) => box));
    this.select = /** @type {HTMLSelectElement} */ (byId("range"));
    this.select.addEventListener("change", () => this.show({ length: Number(this.select.value), end: null }));
    byId("earlier").addEventListener("click", () => this.move(-1));
    byId("later").addEventListener("click", () => this.move(1));
    byId("history-csv").addEventListener("click", () => this.keep());
  }

  /** @param {Choice | null} choice */
  choose(choice) {
    this.choice = choice;
    for (const side of this.sides) if (!side.kept.checked || !side.choice) side.choice = choice;
    this.askedAt = -Infinity;
    if (this.moment) this.take(this.moment);
    this.draw();
  }

  /** Charts change with what is asked for; of a playback only the line at its moment. @param {Moment} moment */
  take(moment) {
    this.moment = moment;
    if (moment.mode === "playback") this.repaint();
    if (!this.isAsking && performance.now() - this.askedAt >= ASK_MS) this.askForAll(moment);
  }

  /** The past of what both sides show; what is over and complete is asked for once. @param {Moment} moment */
  async askForAll(moment) {
    this.isAsking = true;
    this.askedAt = performance.now();
    try {
      const isOver = moment.mode !== "live", wanted = new Map(this.sides.flatMap(({ choice }) => (choice ? [[pathOf(choice), choice]] : [])));
      for (const path of this.pasts.keys()) if (!wanted.has(path)) this.pasts.delete(path);
      for (const path of wanted.keys()) {
        if (isOver && this.pasts.get(path)?.complete) continue;
        const found = await this.ask(path).catch(() => null);
        if (found) this.pasts.set(path, found);
        else this.pasts.delete(path);
      }
      if (isOver && [...this.pasts.values()].some(({ complete }) => !complete)) setTimeout(() => this.moment && this.take(this.moment), ASK_MS);
    } finally {
      this.isAsking = false;
    }
    this.draw();
    if (this.askedAt === -Infinity && this.moment) this.take(this.moment); // something else was chosen meanwhile
  }

  draw() {
    if (!this.moment) return;
    for (const side of this.sides) side.draw(side.choice ? this.pasts.get(pathOf(side.choice)) : undefined, this.moment);
  }

  /** @param {import("./layout.js").Range} range */
  show(range) {
    this.range = range;
    const known = [...this.select.options].find((option) => range.end === null && Number(option.value) === range.length);
    this.select.value = known ? known.value : "NaN";
    this.draw();
  }

  /** By half of what is shown; beyond the newest the charts follow it. @param {number} sign */
  move(sign) {
    const [chart] = this.sides.flatMap((side) => (side.chart ? [side.chart] : []));
    if (!chart) return;
    const [from, to] = rangeOf(chart.data[0], this.range), length = to - from, end = to + (sign * length) / 2;
    this.show({ length, end: end >= chart.data[0].at(-1) ? null : end });
  }

  keep() {
    const found = this.sides.flatMap(({ choice }) => {
      const past = choice && this.pasts.get(pathOf(choice));
      return past ? past.time.flatMap((at, k) => Object.entries(past.columns).map(([name, column]) => [at, choice.kind, choice.id, name, column[k]])) : [];
    });
    keep("history.csv", csvOf(["time", "kind", "id", "quantity", "value"], found));
  }

  /** In the colours that hold now. */
  repaint() {
    for (const { chart } of this.sides) chart?.redraw(false);
  }
}

/** @param {Choice} choice @returns {string} */
function pathOf({ kind, id }) {
  return `/api/history?kind=${kind}&id=${encodeURIComponent(id)}`;
}
