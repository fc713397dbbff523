/** What is wrong in one sentence, above all else: the root cause, then its effects, then further causes. */

import { byId, clock, element, when } from "./format.js";

/** @typedef {import("./types.js").Moment} Moment @typedef {import("./types.js").Cause} Cause */
/** @typedef {{state: "good"|"degraded"|"bad", what: string, action: string, effects: string[], further: string[]}} Said */

const MOST_EFFECTS = 4;
const OF_AREAS = ["gone", "left", "silent", "file", "clock", "router"]; // kinds about an area as a whole
export const PASSING = "under way"; // comes to its end by itself

/** @param {Moment} moment @param {Cause} cause @returns {string} */
function nameOf(moment, { what, since }) {
  return `${what}${since === null ? "" : ` since ${when(moment, since)}`}`;
}

/** @param {Moment} moment @returns {Said} */
export function findSaid(moment) {
  const { causes, view, summary: { voltage } } = moment, areas = Object.values(view.areas), good = areas.filter(({ quality }) => quality === "good").length;
  if (!causes.length) {
    const isSound = areas.length > 0 && good === areas.length, known = `${good} of ${areas.length} areas good, ${voltage.known} of ${voltage.total} buses known`;
    return { state: isSound ? "good" : "degraded", what: isSound ? "✓ Nothing is wrong" : "! Not all is known yet", action: "", effects: [], further: [`${known}.`] };
  }
  const [first, ...others] = causes, more = first.effects.length - MOST_EFFECTS;
  const isPassing = first.kind === PASSING;
  return {
    state: isPassing ? "degraded" : "bad", what: `${isPassing ? "…" : "✕"} ${nameOf(moment, first)}`, action: first.action && `→ ${first.action}`,
    effects: [...first.effects.slice(0, MOST_EFFECTS), ...(more > 0 ? [`${more} more effects`] : [])],
    further: others.map((cause) => `Also: ${nameOf(moment, cause)}${cause.action && `: ${cause.action}`}`),
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
    this.write(lostSince === null ? findSaid(moment) : { state: "bad", what: gone, action: "", effects: [], further: [] });
  }

  /** Only what has changed, so that a screen reader does not say it again. @param {Said} said */
  write(said) {
    const all = JSON.stringify(said);
    if (all === this.shown) return;
    this.shown = all;
    this.place.className = said.state;
    const list = element("ul");
    list.append(...said.effects.map((effect) => element("li", effect)));
    const effects = said.effects.length ? [element("p", "Its effects:", "effects"), list] : [];
    const action = said.action ? [element("p", said.action, "action")] : [];
    this.place.replaceChildren(element("p", said.what, "what"), ...action, ...effects, ...said.further.map((text) => element("p", text, "further")));
  }
}
