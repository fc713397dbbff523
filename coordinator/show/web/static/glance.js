/** What an engineer asks first: voltages, loadings, meters, areas, links, powers; figures of what is fresh only. */

import { placesOf } from "./cause.js";
import { byId, element, entryOf, fixed, qualityClass, shorten, unitOf } from "./format.js";
import { findDeadLinks } from "./links.js";
import { nodesOf } from "./phases.js";

/** @typedef {import("./types.js").Grid} Grid @typedef {import("./types.js").Moment} Moment @typedef {import("./types.js").Choice} Choice */
/** @typedef {import("./types.js").Spread} Spread @typedef {import("./types.js").Total} Total @typedef {import("./types.js").Extreme} Extreme */
/** @typedef {{label: string, choice: Choice}} Offer what can be chosen, and what its button says */
/** @typedef {"good"|"degraded"|"bad"|"unknown"|"none"} State unknown: no value of now is known; none: nothing is judged */
/** @typedef {{title: string, state: State, text: string, offers: Offer[]}} Tile */

const MOST_OFFERS = 4; // of a tile
const MOST_AREAS = 3;
const LONGEST_REASON = 60; // characters
const SIGNS = { good: "✓", degraded: "!", bad: "✕", unknown: "?", none: "" }; // beside the colour, for who does not see it
const REJECTED = ["removed", "silent", "silent: dead", "off"]; // meters that are not used
const OF_METERS = ["map", "many removed", "contradictory"]; // kinds of alarms about meters

/** @param {number} count @param {string} noun @returns {string} */
function counted(count, noun) {
  return `${count} ${noun}${count === 1 ? "" : /(s|ch)$/.test(noun) ? "es" : "s"}`;
}

/**
 * Offers of buses or branches, with the quality of their area unless it is good.
 * @param {Moment} moment @param {Grid} grid @param {"bus"|"branch"} kind @param {string} column whose digits the value has @param {string} [unit]
 * @returns {(extreme: Extreme) => Offer}
 */
function offering({ view }, { buses, branches }, kind, column, unit = "") {
  return ({ at, value }) => {
    const id = placeOf(at);
    const area = kind === "bus" ? buses.area[buses.id.indexOf(Number(id))] : branches.area[branches.id.indexOf(id)], quality = entryOf(view.areas, area)?.quality ?? "good";
    return { label: `${at}: ${fixed(value, column)}${unit}${quality === "good" ? "" : ` (${quality})`}`, choice: { kind, id } };
  };
}

/**
 * Green only where all is known, of areas that are all good: one rule of all tiles with figures.
 * @param {Moment} moment @param {{known: number, total: number}} of @returns {State}
 */
function judge({ view }, { known, total }) {
  if (!known) return "unknown";
  return known === total && Object.values(view.areas).every(({ quality }) => quality === "good") ? "good" : "degraded";
}

/** What the numbers of buses or branches count. @param {Moment} moment @param {string} noun @returns {string} */
function unitOfCount({ summary }, noun) {
  return summary.has_phases ? "phase" : noun;
}

/** @param {Moment} moment @param {Grid} grid @returns {string} how many known buses, or phases of these, are of areas that are not good */
function countDoubtful({ view }, grid) {
  const { buses } = grid, areaOf = new Map(buses.id.map((bus, k) => [bus, buses.area[k]]));
  const doubtful = nodesOf(grid).bus.filter((bus) => {
    const area = entryOf(view.areas, areaOf.get(bus) ?? "");
    return area?.fresh && area.quality !== "good";
  }).length;
  return doubtful ? `; ${doubtful} not of good areas` : "";
}

/** @param {Spread | Total} of @param {string} noun @returns {string} */
function knownOf({ known, total }, noun) {
  return `Of ${counted(total, noun)} ${known} known`;
}

/** @param {Moment} moment @param {Grid} grid @returns {Tile} */
function findVoltages(moment, grid) {
  const { summary: { voltage, unbalance } } = moment, { operating_limits: { lowest_vm_pu: low, highest_vm_pu: high, most_unbalance_percent: mostUnbalance } } = grid, noun = unitOfCount(moment, "bus");
  const title = "Voltage", limits = `${low} to ${high} p.u.`, offer = offering(moment, grid, "bus", "vm_pu"), isWhole = voltage.known === voltage.total && voltage.total > 0;
  if (!voltage.known || !voltage.lowest || !voltage.highest) return { title, state: "unknown", text: `${knownOf(voltage, noun)}.`, offers: [] };
  if (voltage.outside) {
    const rest = isWhole ? "" : ` ${knownOf(voltage, noun)}.`;
    return { title, state: "bad", text: `${counted(voltage.outside, noun)} outside ${limits}${rest}`, offers: voltage.worst.slice(0, MOST_OFFERS).map(offer) };
  }
  const all = `All ${counted(voltage.total, noun)}${describeWhole(grid, voltage.total)}`;
  const text = isWhole ? `${all} within ${limits}` : `${knownOf(voltage, noun)}, within ${limits}`;
  if (unbalance?.outside) {
    return { title, state: "bad", text: `${text}; unbalance of ${counted(unbalance.outside, "bus")} above ${mostUnbalance} %`, offers: unbalance.worst.slice(0, MOST_OFFERS).map(offerUnbalance) };
  }
  const most = unbalance?.highest ? [offerUnbalance(unbalance.highest)] : [];
  return { title, state: judge(moment, voltage), text: text + countDoubtful(moment, grid), offers: [offer(voltage.lowest), offer(voltage.highest), ...most] };
}

/** What all phases are those of. @param {Grid} grid @param {number} total @returns {string} empty without phases */
function describeWhole({ nodes, buses }, total) {
  if (!nodes) return "";
  return nodes.bus.length === total ? ` of ${counted(buses.id.length, "bus")}` : " with a path to ground";
}

/** @param {Extreme} extreme @returns {Offer} the bus whose phases differ most */
function offerUnbalance({ at, value }) {
  return { label: `${at}: unbalance ${value.toFixed(1)} %`, choice: { kind: "bus", id: at } };
}

/** @param {Moment} moment @param {Grid} grid @returns {Tile} */
function findLoadings(moment, grid) {
  const { summary: { loading, current } } = moment, { operating_limits: { most_loading_percent: most } } = grid, noun = unitOfCount(moment, "branch");
  const title = "Loading", offer = offering(moment, grid, "branch", "loading_percent", " %"), strongest = current.highest ? [offering(moment, grid, "branch", "i_from_a", " A")(current.highest)] : [];
  if (!loading.total && !current.total) return { title, state: "none", text: "Without a scenario no current is known.", offers: [] };
  if (!loading.total) return { title, state: current.known ? "none" : "unknown", text: current.known ? "No branch has a rating; the largest current:" : "No current is known.", offers: strongest };
  const rest = loading.known === loading.total ? "" : ` ${knownOf(loading, noun)}.`;
  if (loading.outside) return { title, state: "bad", text: `${counted(loading.outside, noun)} above ${most} %.${rest}`, offers: [...loading.worst.slice(0, MOST_OFFERS - 1).map(offer), ...strongest] };
  const text = loading.known ? `At most ${fixed(loading.highest?.value, "loading_percent")} % of ${most} %.${rest}` : rest.trim();
  return { title, state: judge(moment, loading), text, offers: [...(loading.highest ? [offer(loading.highest)] : []), ...strongest] };
}

/** @param {Moment} moment @param {Grid} grid @returns {Tile} */
function findMeters(moment, { operating_limits: { most_residual: most } }) {
  const { meters, meter_counts: counts, view, causes, summary: { residual } } = moment, title = "Meters", removed = [...new Set(Object.values(view.areas).flatMap((area) => area.removed))];
  const said = REJECTED.filter((status) => counts[status]).map((status) => `${counts[status]} ${status}`).join(", ");
  const readingOf = (/** @type {string} */ id) => {
    const k = meters.meter?.indexOf(id) ?? -1, unit = String(meters.unit?.[k] ?? "");
    return k < 0 ? "" : `, reads ${fixed(meters.reading[k], unit)} ${unitOf(meters.unit?.[k])}, estimated ${fixed(meters.estimate[k], unit)}`;
  };
  /** @type {Offer[]} */ const offers = removed.slice(0, MOST_OFFERS - 1).map((id) => ({ label: `${id} is removed${readingOf(id)}`, choice: { kind: "meter", id } }));
  if (residual.highest) offers.push({ label: `${residual.highest.at}${readingOf(residual.highest.at)}`, choice: { kind: "meter", id: residual.highest.at } });
  const isSure = judge(moment, { known: 1, total: 1 }) === "good"; // then the readings pass the test of J together, and none is a suspect
  const first = said ? `${said}. ` : "", chance = residual.outside && isSure ? ", by chance" : "";
  const text = residual.highest ? `${first}Largest normalised residual ${fixed(residual.highest.value, "normalised_residual")} of ${most}${chance}.` : `${first}No residual is known.`;
  const isAlarm = causes.some(({ kind }) => OF_METERS.includes(kind));
  return { title, state: !residual.highest ? "unknown" : isAlarm ? "bad" : said || !isSure ? "degraded" : "good", text, offers };
}

/** @param {Moment} moment @returns {Tile} */
function findLinks(moment) {
  const title = "Links", { links } = moment, dead = findDeadLinks(moment), alive = links.filter((link) => link.alive).length;
  if (!links.length) return { title, state: "good", text: "No area has a neighbour.", offers: [] };
  const received = alive === links.length ? `All ${alive} directions work.` : `${alive} of ${links.length} directions work`;
  const words = dead.slice(0, MOST_OFFERS).map(({ text }) => text).join("; ");
  const rest = dead.length > MOST_OFFERS ? `; and ${dead.length - MOST_OFFERS} more` : "";
  const text = alive === links.length ? received : `${received}${words ? `: ${words}${rest}` : "; the others have not begun, or an area is gone"}.`;
  return { title, state: !alive ? "bad" : alive < links.length ? "degraded" : "good", text, offers: [] };
}

/** @param {Moment} moment @returns {Tile} */
function findAreas({ view, causes }) {
  const title = "Areas", areas = Object.entries(view.areas), rank = { bad: 0, degraded: 1, good: 2 };
  const poor = areas.filter(([, area]) => area.quality !== "good")
    .sort(([, a], [, b]) => rank[qualityClass(a.quality)] - rank[qualityClass(b.quality)]);
  const roleOf = (/** @type {string} */ id, /** @type {string[]} */ notes) => {
    if (causes.length) return causes.some(({ severity, areas: named }) => severity === causes[0].severity && named.includes(id)) ? ", cause" : ", effect";
    return notes[0] ? `, ${shorten(notes[0], LONGEST_REASON)}` : "";
  };
  if (!areas.length) return { title, state: "bad", text: "Nobody is there.", offers: [] };
  if (!poor.length) return { title, state: "good", text: areas.length === 1 ? "The one area is good." : `All ${areas.length} are good.`, offers: [] };
  return {
    title, state: qualityClass(poor[0][1].quality), text: `${poor.length} of ${areas.length} not good${poor.length > MOST_AREAS ? `; the worst ${MOST_AREAS}, and ${poor.length - MOST_AREAS} more` : ""}.`,
    offers: poor.slice(0, MOST_AREAS).map(([id, area]) => ({ label: `${id}: ${area.quality}${roleOf(id, area.notes)}`, choice: { kind: "area", id } })),
  };
}

/** @param {Moment} moment @returns {Tile} */
function findPowers(moment) {
  const { summary: { head, load, generation, loss } } = moment, ofBuses = unitOfCount(moment, "bus"), ofBranches = unitOfCount(moment, "branch");
  const title = "Power", say = (/** @type {string} */ name, /** @type {Total} */ { p_kw: p, known, total }, /** @type {string} */ noun) =>
    p === null ? [] : [`${name}: ${fixed(p, "p_kw")} kW${known < total ? ` (${known} of ${counted(total, noun)})` : ""}`];
  const words = [...say("head", head, ofBuses), ...say("load", load, ofBuses), ...(Number(fixed(generation.p_kw, "p_kw")) ? say("generation", generation, ofBuses) : []), ...say("losses", loss, ofBranches)];
  return { title, state: words.length ? "none" : "unknown", text: words.length ? words.join("\n") : "No power is known.", offers: [] };
}

/** @param {Moment} moment @param {Grid} grid @returns {Tile[]} */
export function findTiles(moment, grid) {
  return [findVoltages(moment, grid), findLoadings(moment, grid), findMeters(moment, grid), findAreas(moment), findLinks(moment), findPowers(moment)];
}

/**
 * What is worst: the place of the first cause, else what is farthest beyond its limit, else the lowest voltage.
 * @param {Moment} moment @returns {Choice | null}
 */
export function findWorst({ causes, summary: { voltage, loading } }) {
  const [place] = causes.length ? placesOf(causes[0]) : [];
  if (place) return { kind: place[0], id: place[1][0] };
  if (voltage.outside) return { kind: "bus", id: placeOf(voltage.worst[0].at) };
  if (loading.outside) return { kind: "branch", id: placeOf(loading.worst[0].at) };
  return voltage.lowest ? { kind: "bus", id: placeOf(voltage.lowest.at) } : null;
}

/** The bus of a node such as 671.b, or the branch of a conductor such as 632-670.b. @param {string} at */
function placeOf(at) {
  return at.split(".")[0];
}

/** The tiles on the page; buttons are reused, so that focus stays. */
export class Glance {
  /** @param {(choice: Choice) => void} choose */
  constructor(choose) {
    this.choose = choose;
    this.holder = byId("glance");
  }

  /** @param {Moment} moment @param {Grid} grid */
  show(moment, grid) {
    findTiles(moment, grid).forEach((tile, k) => this.write(this.holder.children[k] ?? this.add(), tile));
  }

  add() {
    const tile = element("div");
    tile.append(element("h2"), element("p"), element("div", "", "offers"));
    this.holder.append(tile);
    return tile;
  }

  /** @param {Element} place @param {Tile} tile */
  write(place, { title, state, text, offers }) {
    const [heading, words, list] = place.children;
    place.className = `tile ${state}`;
    for (const [line, said] of /** @type {[Element, string][]} */ ([[heading, `${SIGNS[state]} ${title}`.trim()], [words, text]])) {
      if (line.textContent !== said) line.textContent = said;
    }
    while (list.children.length > offers.length) list.lastElementChild?.remove();
    offers.forEach(({ label, choice }, k) => {
      let button = /** @type {HTMLButtonElement | undefined} */ (list.children[k]);
      if (!button) {
        button = /** @type {HTMLButtonElement} */ (element("button"));
        button.type = "button";
        list.append(button);
      }
      if (button.textContent !== label) button.textContent = label;
      button.onclick = () => this.choose(choice);
    });
  }
}
