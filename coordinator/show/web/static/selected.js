/** What is chosen: all that is known of it at the moment that is shown, and its past. */

import { Past } from "./charts.js";
import { byId, element, entryOf, labelOf, number, unitOf } from "./format.js";
import { countReceived } from "./links.js";

/** @typedef {import("./types.js").Grid} Grid @typedef {import("./types.js").Moment} Moment */
/** @typedef {import("./types.js").Choice} Choice @typedef {import("./types.js").Rows} Rows */
/** @typedef {[string, string]} Fact its name and what it is */

const PAST_MS = 2000; // between two times that the past is asked for

/** @param {Moment} moment @param {string} id @returns {Fact[]} */
function describeArea(moment, id) {
  const area = entryOf(moment.view.areas, id);
  if (!area) return [["area", id], ["quality", "not there"]];
  return [
    ["area", id], ["quality", area.quality], ["why", area.notes.join("; ") || "nothing to remark"], ["it says", area.said_quality],
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
  return [...given, ["areas", grid.buses.areas[place].join(", ")]];
}

/** @param {string} name @param {number | string | null} value @returns {Fact} */
function describeValue(name, value) {
  return [labelOf(name), name === "unit" ? unitOf(value) : typeof value === "string" ? value : number(value, 6)];
}

export class Selected {
  /** @param {(path: string) => Promise<any>} ask */
  constructor(ask) {
    this.ask = ask;
    this.past = new Past();
    /** @type {Choice | null} */ this.choice = null;
    /** @type {Rows | null} */ this.found = null; // of the choice
    this.pastAt = -Infinity;
    /** @type {[Moment, Grid] | null} */ this.shown = null;
    /** @type {Promise<void> | null} */ this.asking = null;
  }

  /** @param {Choice} choice */
  choose(choice) {
    this.choice = choice;
    this.found = null;
    this.pastAt = -Infinity;
    this.past.clear();
  }

  /** @param {Moment} moment @param {Grid} grid */
  show(moment, grid) {
    byId("nothing").hidden = this.choice !== null;
    this.write(moment, grid);
    if (!this.choice) return;
    this.shown = [moment, grid];
    this.asking ??= this.askForRow().finally(() => (this.asking = null));
    if (performance.now() - this.pastAt >= PAST_MS) this.askForPast(this.choice, moment.mode === "live");
  }

  /** @param {Moment} moment @param {Grid} grid */
  write(moment, grid) {
    const { choice, found } = this;
    /** @type {Fact[]} */ let facts = [];
    if (choice?.kind === "area") facts = describeArea(moment, choice.id);
    else if (choice) {
      const known = Object.entries(found?.rows ?? {}).filter(([name, column]) => name !== "id" && name !== "meter" && column.length);
      facts = [[choice.kind, choice.id], ...describePlace(grid, choice), ...known.map(([name, column]) => describeValue(name, column[0]))];
    }
    byId("facts").replaceChildren(...facts.flatMap(([name, value]) => [element("dt", name), element("dd", value)]));
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

  /** @param {Choice} choice @param {boolean} ofDay */
  async askForPast(choice, ofDay) {
    this.pastAt = performance.now();
    const { kind, id } = choice;
    try {
      const found = await this.ask(`/api/history?kind=${kind}&id=${encodeURIComponent(id)}`);
      if (choice !== this.choice) return;
      this.past.show(kind, id, found, ofDay);
      if (ofDay) return;
      this.pastAt = Infinity; // what is over does not change
      if (!found.complete) setTimeout(() => choice === this.choice && this.askForPast(choice, ofDay), PAST_MS);
    } catch {
      this.past.clear();
    }
  }

  /** In the colours that hold now. */
  repaint() {
    this.past.repaint();
  }
}
