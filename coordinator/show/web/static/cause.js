/** What is wrong in one sentence, above all else: the root cause in full, a line of its effects, further causes in a line each. */

import { byId, clock, element, when } from "./format.js";

/** @typedef {import("./types.js").Moment} Moment @typedef {import("./types.js").Cause} Cause */
/** @typedef {{state: "good"|"degraded"|"bad", what: string, action: string, remark: string, further: string[]}} Said */

const MOST_FURTHER = 2; // causes beside the first one, a line each
const OF_AREAS = ["gone", "left", "silent", "file", "clock", "router"]; // kinds about an area as a whole
export const PASSING = "under way"; // comes to its end by itself

/** @param {Pick<Cause, "severity">} cause @returns {"degraded"|"bad"} class of its colour */
export function gradeOf({ severity }) {
  return severity === "warning" ? "degraded" : "bad";
}

/** @param {Moment} moment @param {Cause} cause @returns {string} */
function nameOf(moment, { what, since, scope }) {
  return `${what}${since === null ? "" : `${scope === "grid" ? ", seen since" : " since"} ${when(moment, since)}`}`;
}

/** @param {Moment} moment @returns {Said} */
export function findSaid(moment) {
  const { causes, view, summary: { voltage, has_phases: hasPhases } } = moment, areas = Object.values(view.areas), good = areas.filter(({ quality }) => quality === "good").length;
  if (!causes.length) {
    const isSound = areas.length > 0 && good === areas.length, known = `${good} of ${areas.length} areas good, ${voltage.known} of ${voltage.total} ${hasPhases ? "phases of buses" : "buses"} known`;
    return { state: isSound ? "good" : "degraded", what: isSound ? "✓ Nothing is wrong" : "! Not all is known yet", action: "", remark: `${known}.`, further: [] };
  }
  const [first, ...others] = causes, state = gradeOf(first), more = others.length - MOST_FURTHER;
  const sign = first.kind === PASSING ? "…" : state === "bad" ? "✕" : "!", effects = first.effects.length ? ` Effects: ${first.effects.join(", ")}.` : "";
  return {
    state, what: `${sign} ${nameOf(moment, first)}`, action: first.action && `→ ${first.action}`, remark: first.remark + effects,
    further: others.slice(0, MOST_FURTHER).map((cause, k) =>
      `Also: ${nameOf(moment, cause)}${cause.action && `: ${cause.action}`}${more > 0 && k === MOST_FURTHER - 1 ? `; and ${more} more` : ""}`),
  };
}

/**
 * Where a cause is, the most telling place first: what is gone is an area, all else is at a meter, on a branch, at a bus.
 * @param {Cause} cause @returns {[import("./types.js").Choice["kind"], string[]][]}
 */
export function placesOf({ kind, areas, buses, branches, meters }) {
  /** @type {[import("./types.js").Choice["kind"], string[]]} */ const ofAreas = ["area", areas];
  /** @type {[import("./types.js").Choice["kind"], string[]][]} */ const others = [["meter", meters], ["branch", branches], ["bus", buses.map(String)]];
  return (OF_AREAS.includes(kind) ? [ofAreas, ...others] : [...others, ofAreas]).filter(([, ids]) => ids.length > 0);
}

export class CauseBanner {
  constructor() {
    this.place = byId("cause");
    this.shown = "";
  }

  /** @param {Moment} moment @param {number | null} lostSince s since 1970 when the server was heard last; null: it is heard */
  show(moment, lostSince) {
    document.body.classList.toggle("lost", lostSince !== null);
    const gone = `✕ The server of this page has sent nothing since ${clock(lostSince ?? 0)}: all below is as it was then.`;
    this.write(lostSince === null ? findSaid(moment) : { state: "bad", what: gone, action: "", remark: "", further: [] });
  }

  /** Only what has changed, so that a screen reader does not say it again. @param {Said} said */
  write(said) {
    const all = JSON.stringify(said);
    if (all === this.shown) return;
    this.shown = all;
    this.place.className = said.state;
    const of = { what: [said.what], action: [said.action], remark: [said.remark], further: said.further };
    this.place.replaceChildren(...Object.entries(of).flatMap(([name, lines]) => lines.filter(Boolean).map((line) => element("p", line, name))));
  }
}
