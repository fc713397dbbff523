/** What has changed, the newest first; what lasted less than a scan only where all changes are asked for. */

import { byId, element, when } from "./format.js";

/** @typedef {import("./types.js").Moment} Moment @typedef {import("./types.js").Event} Event */

const MOST_EVENTS = 60;

/** @param {Event} event @returns {string} what it says something about; a later event about the same replaces it */
function subjectOf({ area, kind, text }) {
  const link = kind === "link" ? text.replace(/^receives (nothing )?from /, "").replace(/ again$/, "") : "";
  const presence = kind === "appeared" || kind === "vanished" ? "presence" : kind;
  return JSON.stringify([area, presence, kind === "removed" ? text : link]);
}

/** @param {Event} event @returns {string} what holds from then on, whatever else the text says */
function stateOf({ kind, text }) {
  return kind === "link" ? String(text.startsWith("receives nothing")) : kind === "quality" ? text.split(":")[0] : kind === "operator" ? text : kind;
}

/**
 * Events without what lasted less than `least` seconds, and without those that then say what held before; what still
 * holds stays, however short.
 * @param {Event[]} events in the order of their times @param {number} least @returns {Event[]}
 */
export function findLasting(events, least) {
  /** @type {Map<string, Event>} */ const following = new Map();
  /** @type {Set<Event>} */ const brief = new Set();
  for (const event of [...events].reverse()) {
    const subject = subjectOf(event), next = following.get(subject);
    if (next && next.time - event.time < least) brief.add(event);
    following.set(subject, event);
  }
  /** @type {Map<string, string>} */ const holds = new Map();
  return events.filter((event) => {
    const subject = subjectOf(event), state = stateOf(event), isNew = holds.get(subject) !== state;
    if (brief.has(event)) return false;
    holds.set(subject, state);
    return isNew;
  });
}

export class Events {
  constructor() {
    this.lines = "";
    this.box = /** @type {HTMLInputElement} */ (byId("all-events"));
    /** @type {Moment | null} */ this.moment = null;
    this.box.addEventListener("change", () => this.moment && this.show(this.moment));
  }

  /** @param {Moment} moment @returns {Event[]} */
  pick(moment) {
    return this.box.checked ? moment.events : findLasting(moment.events, moment.scan_s ?? 0);
  }

  /** The list is left alone while nothing new is in it, so that who reads or scrolls it can. @param {Moment} moment */
  show(moment) {
    this.moment = moment;
    const picked = this.pick(moment), left = moment.events.length - picked.length;
    byId("events-note").textContent = left ? `${left} more lasted less than a scan, or changed nothing.` : "";
    const lines = picked.slice(-MOST_EVENTS).reverse().map((event) => `${when(moment, event.time)} ${event.area} ${event.text}`);
    const all = lines.join("\n");
    if (all === this.lines) return;
    this.lines = all;
    byId("events").replaceChildren(...lines.map((line) => element("li", line)));
  }
}
