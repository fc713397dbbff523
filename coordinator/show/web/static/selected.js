/** What is chosen: all that is known of it at the moment that is shown, each number with its quality unless it is good. */

import { byId, element, entryOf, fixed, labelOf, number, qualityClass, unitOf } from "./format.js";
import { countReceived } from "./links.js";

/** @typedef {import("./types.js").Grid} Grid @typedef {import("./types.js").Moment} Moment */
/** @typedef {import("./types.js").Choice} Choice @typedef {import("./types.js").Rows} Rows */
/** @typedef {[string, string, string?]} Fact its name, what it is, and the class of its colour */

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
  const place = kind === "bus" ? grid.buses.id.indexOf(Number(id)) : -1;
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

export class Selected {
  /** @param {(path: string) => Promise<any>} ask */
  constructor(ask) {
    this.ask = ask;
    /** @type {Choice | null} */ this.choice = null;
    /** @type {Rows | null} */ this.found = null; // of the choice
    /** @type {[Moment, Grid] | null} */ this.shown = null;
    /** @type {Promise<void> | null} */ this.asking = null;
  }

  /** @param {Choice} choice */
  choose(choice) {
    this.choice = choice;
    this.found = null;
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
    if (choice?.kind === "area") facts = describeArea(moment, choice.id);
    else if (choice) {
      facts = [[choice.kind, choice.id], ...describePlace(grid, choice), ...(found?.total ? describeRow(found.rows) : [])];
    }
    byId("facts").replaceChildren(...facts.flatMap(([name, value, look]) => [element("dt", name), element("dd", value, look)]));
  }

  /** One question after the other, the last one about what is shown then: a slow answer makes no queue. */
  async askForRow() {
    for (let asked = null; this.shown && asked !== this.shown;) {
      const [moment, grid] = (asked = this.shown), { choice } = this;
      if (!choice || choice.kind === "area") return;
      const frame = moment.mode === "playback" ? `&frame=${moment.number}` : "";
      const found = await this.ask(`/api/rows?kind=${choice.kind}&id=${encodeURIComponent(choice.id)}${frame}`).catch(() => null);
      if (!found || choice !== this.choice) continue; // the next moment asks again
      this.found = found;
      this.write(moment, grid);
    }
  }
}
