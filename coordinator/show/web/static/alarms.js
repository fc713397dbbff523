/** Causes that need a person: what is wrong now, and what is over but has not been acknowledged; kept in this browser. */

import { gradeOf, PASSING } from "./cause.js";
import { byId, element, when } from "./format.js";

/** @typedef {import("./types.js").Moment} Moment @typedef {import("./types.js").Cause} Cause */
/** @typedef {{key: string, places: string[], what: string, since: number|null, over: number|null, acknowledged: boolean, severity: string}} Alarm */

const MOST_ALARMS = 200;
const MOST_SHOWN = 3; // until somebody asks for all
const LEAST_S = 2; // what is over sooner is no alarm any more
const PLACE = "alarms"; // in what the browser keeps

/** @param {Cause} cause @returns {string} the same for a cause as long as it lasts, whatever figures and places its words have */
function keyOf({ kind, areas }) {
  return JSON.stringify([kind, ...areas]);
}

/** @param {Cause} cause @returns {string[]} */
function findPlaces({ buses, branches, meters }) {
  return [...buses.map(String), ...branches, ...meters];
}

/**
 * The alarms after a moment. One that spreads to another place is not acknowledged any more. One that is over goes if it is acknowledged, or has lasted less than `least` seconds; one
 * that comes back is new.
 * @param {Alarm[]} before @param {Cause[]} causes @param {number} at @param {number} least @returns {Alarm[]} the newest first
 */
export function updateAlarms(before, causes, at, least) {
  const now = new Map(causes.filter(({ kind }) => kind !== PASSING).map((cause) => [keyOf(cause), cause]));
  const kept = before.flatMap((alarm) => {
    const cause = now.get(alarm.key);
    if (cause && alarm.over === null) {
      now.delete(alarm.key);
      const places = [...new Set([...alarm.places, ...findPlaces(cause)])];
      return [{ ...alarm, places, what: cause.what, acknowledged: alarm.acknowledged && places.length === alarm.places.length }];
    }
    const over = alarm.over ?? at;
    return alarm.acknowledged || over - (alarm.since ?? at) < least ? [] : [{ ...alarm, over }];
  });
  const fresh = [...now].map(([key, cause]) => ({ key, places: findPlaces(cause), what: cause.what, severity: cause.severity, since: cause.since ?? at, over: null, acknowledged: false }));
  return [...fresh, ...kept].slice(0, MOST_ALARMS);
}

/** @param {Alarm} alarm @returns {number} the lowest first: what lasts and is grave, what lasts, what is over, what is acknowledged */
function rankOf({ acknowledged, over, severity }) {
  return acknowledged ? 3 : over !== null ? 2 : severity === "warning" ? 1 : 0;
}

/** What the browser keeps of the alarms of a run; it may refuse, and what it kept may be anything. @param {string} run @returns {Alarm[]} */
function read(run) {
  try {
    const kept = JSON.parse(localStorage.getItem(PLACE) ?? "{}");
    return kept.run === run ? kept.alarms.filter((/** @type {any} */ alarm) => typeof alarm.key === "string" && typeof alarm.what === "string" && Array.isArray(alarm.places)) : [];
  } catch {
    return [];
  }
}

export class Alarms {
  constructor() {
    this.list = byId("alarms");
    /** @type {Alarm[]} */ this.alarms = [];
    this.shown = "";
    this.hasAll = false; // on the screen
    /** @type {Moment | null} */ this.moment = null;
    byId("acknowledge-all").addEventListener("click", () => this.acknowledge(() => true));
  }

  /** Of a playback those of the moment only: its end is not now. @param {Moment} moment */
  show(moment) {
    this.moment = moment;
    const isLive = moment.mode === "live", alarms = updateAlarms(isLive ? read(moment.view.run) : this.alarms, moment.causes ?? [], moment.at, Math.max(LEAST_S, moment.scan_s ?? 0));
    this.write(isLive ? alarms : alarms.filter(({ over }) => over === null), moment);
  }

  /** @param {(alarm: Alarm) => boolean} isMeant */
  acknowledge(isMeant) {
    if (!this.moment) return;
    const alarms = this.alarms.map((alarm) => (isMeant(alarm) ? { ...alarm, acknowledged: true } : alarm));
    this.write(alarms.filter(({ acknowledged, over }) => !acknowledged || over === null), this.moment);
  }

  /** @param {Alarm[]} alarms @param {Moment} moment */
  write(alarms, moment) {
    this.alarms = alarms;
    const all = JSON.stringify({ run: moment.view.run, alarms }), shown = `${this.hasAll} ${all}`;
    if (shown === this.shown) return;
    this.shown = shown;
    try {
      if (moment.mode === "live") localStorage.setItem(PLACE, all);
    } catch {} // full, or not allowed: they are kept until the page is left
    const open = alarms.filter(({ acknowledged }) => !acknowledged).length;
    byId("acknowledge-all").hidden = open === 0;
    const ordered = [...alarms].sort((one, other) => rankOf(one) - rankOf(other)), more = this.hasAll ? 0 : alarms.length - MOST_SHOWN;
    byId("alarms-note").textContent = alarms.length ? `${open} not acknowledged${more > 0 ? `, ${MOST_SHOWN} shown` : ""}.` : "None.";
    this.list.replaceChildren(...(more > 0 ? ordered.slice(0, MOST_SHOWN) : ordered).map((alarm) => this.describe(alarm, moment)), ...(more > 0 ? [this.offerAll(more)] : []));
  }

  /** @param {number} more @returns {HTMLElement} */
  offerAll(more) {
    const line = element("li"), button = /** @type {HTMLButtonElement} */ (element("button", `and ${more} more`));
    button.type = "button";
    button.addEventListener("click", () => {
      this.hasAll = true;
      if (this.moment) this.write(this.alarms, this.moment);
    });
    line.append(button);
    return line;
  }

  /** @param {Alarm} alarm @param {Moment} moment @returns {HTMLElement} */
  describe({ key, what, severity, since, over, acknowledged }, moment) {
    const began = since === null ? "" : `${when(moment, since)} `, ended = over === null ? "" : `, over since ${when(moment, over)}`;
    const line = element("li", "", over === null ? gradeOf({ severity }) : "over"), text = element("span", `${began}${what}${ended}`);
    line.append(text);
    if (acknowledged) {
      line.append(element("small", " acknowledged"));
      return line;
    }
    const button = /** @type {HTMLButtonElement} */ (element("button", "Acknowledge"));
    button.type = "button";
    button.setAttribute("aria-label", `Acknowledge: ${what}`);
    button.addEventListener("click", () => this.acknowledge((alarm) => alarm.key === key && alarm.over === over));
    line.append(" ", button);
    return line;
  }
}
