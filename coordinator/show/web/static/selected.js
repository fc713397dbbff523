/** What is chosen: all that is known of it at the moment that is shown, each number with its quality unless it is good. */

import { byId, element, entryOf, fixed, labelOf, number, qualityClass, unitOf } from "./format.js";
import { countReceived } from "./links.js";
import { ALL, lookOf } from "./phases.js";
import { Rows } from "./rows.js";

/** @typedef {import("./types.js").Grid} Grid @typedef {import("./types.js").Moment} Moment */
/** @typedef {import("./types.js").Choice} Choice */
/** @typedef {import("./types.js").Columns} Columns */
/** @typedef {[string, string, string?]} Fact its name, what it is, and the class of its colour */
/** @typedef {{phases: string[], rows: string[][]}} ByPhase a row for each quantity: its name, each phase, all of them together */

export const FINE = ["used", "critical", "not received"]; // statuses of meters
const MOST_METERS = 30; // of one bus or branch
const QUANTITIES = ["vm_pu", "sigma_vm_pu", "vm_kv", "va_deg", "sigma_va_deg", "p_kw", "q_kvar", "p_from_kw", "q_from_kvar", "i_from_a", "i_to_a", "loading_percent"];
const SUMMED = ["p_kw", "q_kvar", "p_from_kw", "q_from_kvar"]; // over the phases
const TO_GROUND = ["vm_pu", "sigma_vm_pu", "vm_kv", "va_deg", "sigma_va_deg"]; // means nothing without a path to ground
const ABOUT = ["id", "meter", "quality", "value_age_s", "fresh"]; // columns that are no values

/** @param {Moment} moment @param {string} id @returns {Fact[]} */
function describeArea(moment, id) {
  const area = entryOf(moment.view.areas, id);
  if (!area) return [["area", id], ["quality", "not there"]];
  const own = area.notes.filter((note) => !note.startsWith("behind ")); // what neighbours have passed on says no more
  return [
    ["area", id], ["quality", area.quality, qualityClass(area.quality)], ...(area.said_quality === area.quality ? [] : [/** @type {Fact} */ ([area.fresh ? "it says" : "it said before", area.said_quality])]),
    ["its notes", (own.length ? own : area.notes).join("; ") || "none"],
    ["values", ageOf(area.fresh, area.value_age_s), area.fresh ? "" : "bad"],
    ["receives from", countReceived(moment.links).get(id) ?? "-"],
    ["J", `${number(area.objective, 4)} with ${area.degrees_of_freedom} degrees of freedom`], ["oldest reading", `${number(area.oldest_reading_s, 3)} s`],
    ["removed", area.removed.join(", ") || "none"], ["off", area.meters_off.join(", ") || "none"],
    ["rejected", Object.entries(area.rejected).map(([why, n]) => `${why} ${n}`).join(", ") || "nothing"], ["bytes", String(area.bytes)],
  ];
}

/** @param {Grid} grid @param {Choice} choice @returns {Fact[]} what of it does not change */
function describePlace(grid, { kind, id }) {
  const place = kind === "bus" ? grid.buses.id.indexOf(Number(id)) : -1, branch = kind === "branch" && grid.conductors ? grid.branches.id.indexOf(id) : -1;
  if (branch >= 0) return [["from", String(grid.branches.from_bus[branch])], ["to", String(grid.branches.to_bus[branch])]];
  if (place < 0) return [];
  const name = grid.buses.name[place], kv = grid.buses.base_kv[place];
  /** @type {Fact[]} */ const given = [...(name ? [/** @type {Fact} */ (["name", name])] : []), ...(kv === null ? [] : [/** @type {Fact} */ (["base kV", number(kv)])])];
  const others = grid.buses.areas[place].filter((area) => area !== grid.buses.area[place]);
  return [...given, ...(others.length ? [/** @type {Fact} */ (["shared with", others.join(", ")])] : [])];
}

/** @param {unknown} fresh @param {unknown} age s, null where there is no value @returns {string} */
export function ageOf(fresh, age) {
  if (typeof age !== "number") return "none";
  return fresh ? `${number(age, 3)} s old` : `not fresh: the last ones, ${number(age, 4)} s old`;
}

/** @param {import("./types.js").Columns} row of one thing @returns {Fact[]} its values; each says so where it is not good */
export function describeRow(row) {
  const { quality: [quality] = [], fresh: [fresh] = [], value_age_s: [age] = [], unit: [unit] = [] } = row;
  const doubt = quality === undefined || quality === "good" ? "" : fresh ? ` (${quality})` : ` (${quality}, ${ageOf(true, age)})`;
  const isOld = fresh === false;
  /** @type {Fact[]} */ const about = quality === undefined ? [] : [["quality of its area", String(quality), qualityClass(String(quality))], ["values", ageOf(fresh, age), isOld ? "bad" : ""]];
  const names = Object.keys(row).filter((name) => !ABOUT.includes(name) && row[name].length && row[name][0] !== "");
  return [...about, ...names.map((name) => {
    const value = row[name][0], isReading = ["reading", "estimate", "sigma"].includes(name);
    if (name === "unit") return /** @type {Fact} */ ([labelOf(name), unitOf(value)]);
    if (typeof value === "string") return /** @type {Fact} */ ([labelOf(name), value]);
    const text = fixed(value, isReading ? String(unit ?? "") : name);
    return /** @type {Fact} */ ([labelOf(name), text === "-" ? text : text + doubt, isOld ? "old" : ""]);
  })];
}

/** @param {Columns} row @returns {boolean} rows of phases, of a bus or branch */
function isByPhase({ phase = [], meter }) {
  return !meter && phase.some((each) => each !== ALL);
}

/**
 * One row of each phase, a fresh one if there is one: without a scenario a boundary bus has rows of each area that sees it.
 * @param {Columns} rows of all phases of a bus or branch @returns {Columns} phase after phase
 */
export function pickPhases(rows) {
  /** @type {Map<unknown, number>} */ const place = new Map();
  rows.phase.forEach((phase, k) => {
    const known = place.get(phase);
    if (known === undefined || (rows.fresh?.[k] && !rows.fresh[known])) place.set(phase, k);
  });
  const order = [...place].sort(([one], [other]) => String(one).localeCompare(String(other))).map(([, k]) => k);
  return Object.fromEntries(Object.entries(rows).map(([name, column]) => [name, order.map((k) => column[k])]));
}

/** @param {Columns} rows @param {string} name @returns {number | null} the sum over all phases, null unless all are known */
function sumOf(rows, name) {
  const values = rows[name] ?? [];
  return values.every((value) => typeof value === "number") ? values.reduce((sum, value) => sum + Number(value), 0) : null;
}

/** @param {Columns} rows of all phases of a bus or branch @returns {ByPhase} */
export function tabulatePhases(rows) {
  const isGrounded = rows.grounded?.[0] !== false, alike = sameAs(rows, "i_from_a", "i_to_a") ? ["i_to_a"] : [];
  const shown = QUANTITIES.filter((name) => rows[name]?.some((value) => value !== null) && !alike.includes(name) && (isGrounded || !TO_GROUND.includes(name)));
  return {
    phases: rows.phase.map(String),
    rows: shown.map((name) => [
      labelOf(name), ...rows[name].map((value) => (isGrounded ? fixed(value, name) : "-")), SUMMED.includes(name) ? fixed(sumOf(rows, name), name) : "",
    ]),
  };
}

/** @param {Columns} rows @param {string} one @param {string} other @returns {boolean} they are shown alike in each row */
function sameAs(rows, one, other) {
  return rows[one]?.every((value, k) => fixed(value, one) === fixed(rows[other]?.[k], one)) ?? false;
}

/** @param {Columns} rows of a bus without a path to ground @returns {Fact[]} the voltages between its phases */
function describeBetween({ phase, vm_kv: kv = [], va_deg: deg = [] }) {
  const pairs = phase.length === 3 ? [[0, 1], [1, 2], [2, 0]] : phase.length === 2 ? [[0, 1]] : [];
  return pairs.map(([i, j]) => {
    const [x, y] = [Math.cos, Math.sin].map((part) => [i, j].map((k) => Number(kv[k]) * part((Number(deg[k]) * Math.PI) / 180)));
    const isKnown = [kv[i], kv[j], deg[i], deg[j]].every((value) => typeof value === "number");
    return [`voltage ${phase[i]} to ${phase[j]} (kV)`, isKnown ? fixed(Math.hypot(x[0] - x[1], y[0] - y[1]), "vm_kv") : "-"];
  });
}

/** @param {Columns} rows of all phases of a bus or branch @returns {Fact[]} what holds for all of them together */
export function describeTogether(rows) {
  const { quality: [quality] = [], fresh: [fresh] = [], value_age_s: [age] = [], phase } = rows, look = fresh === false ? "old" : "";
  const first = (/** @type {string} */ name) => rows[name]?.find((value) => value !== null);
  const loading = rows.loading_percent?.some((value) => value !== null) ? "loading_percent" : "i_from_a", loads = (rows[loading] ?? []).map((value, k) => Math.max(Number(value ?? -1), loading === "i_from_a" ? Number(rows.i_to_a?.[k] ?? -1) : -1));
  /** @type {Fact[]} */ const facts = [
    ["quality of its area", String(quality), qualityClass(String(quality))], ["values", ageOf(fresh, age), fresh === false ? "bad" : ""],
    ...["area", "injection_problem"].flatMap((name) => (rows[name]?.[0] ? [/** @type {Fact} */ ([labelOf(name), String(rows[name][0])])] : [])),
    ["phases", phase.join(", ")],
  ];
  for (const name of ["unbalance_percent", "neutral_a"]) if (first(name) !== undefined) facts.push([labelOf(name), fixed(first(name), name), look]);
  if (loads.length > 1 && Math.max(...loads) > 0) {
    const k = loads.indexOf(Math.max(...loads));
    facts.push(["most loaded phase", `${phase[k]}, ${fixed(loads[k], loading)} ${loading === "i_from_a" ? "A" : "%"}`, look]);
  }
  if (rows.loss_kw) facts.push([`${labelOf("loss_kw")}, all phases`, fixed(sumOf(rows, "loss_kw"), "loss_kw"), look]);
  if (rows.grounded?.[0] === false) facts.push(["path to ground", "none: only voltages between phases mean anything"], ...describeBetween(rows));
  return facts;
}

export class Selected {
  /** @param {(path: string) => Promise<any>} ask @param {(choice: Choice) => void} onChoose */
  constructor(ask, onChoose) {
    this.ask = ask;
    this.onChoose = onChoose;
    /** @type {Rows | null} */ this.table = null; // of the phases
    this.phases = ""; // its columns
    this.meters = new Rows("meters-there", "Meters there", [
      { title: "Meter" }, { title: "Phase" }, { title: "Reading", number: true }, { title: "Estimate", number: true },
    ]);
    /** @type {Columns} */ this.there = {}; // the meters at the choice
    /** @type {Choice | null} */ this.choice = null;
    /** @type {import("./types.js").Rows | null} */ this.found = null; // of the choice
    /** @type {[Moment, Grid] | null} */ this.shown = null;
    /** @type {Promise<void> | null} */ this.asking = null;
  }

  /** @param {Choice} choice */
  choose(choice) {
    this.choice = choice;
    this.found = null;
    this.there = {};
  }

  /** @param {Moment} moment @param {Grid} grid */
  show(moment, grid) {
    byId("nothing").hidden = this.choice !== null;
    this.write(moment, grid);
    if (!this.choice) return;
    this.shown = [moment, grid];
    this.asking ??= this.askForRow().finally(() => (this.asking = null));
  }

  /** @param {Moment} moment @param {Grid} grid */
  write(moment, grid) {
    const { choice, found } = this;
    /** @type {Fact[]} */ let facts = [];
    const byPhase = found && isByPhase(found.rows) ? pickPhases(found.rows) : null;
    if (choice?.kind === "area") facts = describeArea(moment, choice.id);
    else if (choice) {
      facts = [[choice.kind, choice.id], ...describePlace(grid, choice), ...(byPhase ? describeTogether(byPhase) : found?.total ? describeRow(found.rows) : [])];
    }
    this.writePhases(byPhase);
    byId("facts").replaceChildren(...facts.flatMap(([name, value, look]) => [element("dt", name), element("dd", value, look)]));
  }

  /** A column for each phase, and the meters there. @param {Columns | null} found */
  writePhases(found) {
    const { meter = [], status, phase, reading, estimate, unit } = this.there;
    byId("by-phase").hidden = !found;
    byId("there").hidden = !found || !meter.length;
    if (!found) return;
    const { phases, rows } = tabulatePhases(found), columns = phases.join(), quality = found.quality?.[0], isOld = found.fresh?.[0] === false;
    if (this.table === null || this.phases !== columns) {
      this.phases = columns;
      this.table = new Rows("by-phase", "Each phase", [
        { title: "" }, ...phases.map((each) => ({ title: `${lookOf(each).sign} ${each}`, number: true })), { title: "all", number: true },
      ]);
    }
    byId("by-phase").querySelector("caption")?.replaceChildren(`Each phase${quality === undefined || quality === "good" ? "" : ` (${quality})`}`);
    void this.table.show(rows.map((cells) => ({ cells, old: isOld })));
    void this.meters.show(meter.slice(0, MOST_METERS).map((id, k) => {
      const isFine = FINE.includes(String(status[k])), of = String(unit?.[k] ?? "");
      return {
        cells: [String(id), `${phase?.[k] ?? "-"}${isFine ? "" : `, ${status[k]}`}`, `${fixed(reading[k], of)} ${unitOf(unit?.[k])}`, fixed(estimate[k], of)],
        className: isFine ? "" : "bad",
        choose: () => this.onChoose({ kind: "meter", id: String(id) }),
      };
    }));
  }

  /** One question after the other, the last one about what is shown then: a slow answer makes no queue. */
  async askForRow() {
    for (let asked = null; this.shown && asked !== this.shown;) {
      const [moment, grid] = (asked = this.shown), { choice } = this;
      if (!choice || choice.kind === "area") return;
      const frame = moment.mode === "playback" ? `&frame=${moment.number}` : "";
      const found = await this.ask(`/api/rows?kind=${choice.kind}&id=${encodeURIComponent(choice.id)}${frame}`).catch(() => null);
      const there = found && isByPhase(found.rows) ? await this.ask(`/api/rows?kind=meter&at=${encodeURIComponent(choice.id)}${frame}`).catch(() => null) : null;
      if (!found || choice !== this.choice) continue; // the next moment asks again
      this.found = found;
      this.there = there?.rows ?? {};
      this.write(moment, grid);
    }
  }
}
