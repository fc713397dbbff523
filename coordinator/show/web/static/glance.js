/** What an engineer asks first: limits violated, the worst meter, dead links, areas that are not good. */

import { byId, element, number, qualityClass } from "./format.js";
import { findDeadLinks } from "./links.js";

/** @typedef {import("./types.js").Grid} Grid @typedef {import("./types.js").Moment} Moment @typedef {import("./types.js").Choice} Choice */
/** @typedef {{label: string, choice: Choice}} Offer what can be chosen, and what its button says */
/** @typedef {{title: string, state: "good"|"degraded"|"bad", text: string, offers: Offer[]}} Tile */

const MOST_OFFERS = 4; // of a tile
const SIGNS = { good: "✓", degraded: "!", bad: "✕" }; // beside the colour, for who does not see it
const REJECTED = ["removed", "silent", "off"]; // meters that are not used

/** @param {number} count @param {string} noun @returns {string} */
function counted(count, noun) {
  return `${count} ${noun}${count === 1 ? "" : noun.endsWith("s") ? "es" : "s"}`;
}

/** @param {number} count of what is offered @returns {string} */
function more(count) {
  return count > MOST_OFFERS ? `, the worst ${MOST_OFFERS} of them:` : ":";
}

/** @param {number} bus @param {number} vm @returns {Offer} */
function offerBus(bus, vm) {
  return { label: `${bus}: ${number(vm, 4)}`, choice: { kind: "bus", id: String(bus) } };
}

/** @param {Moment} moment @param {Grid} grid @returns {Tile} */
function findVoltages(moment, grid) {
  const title = "Voltage limits", [low, high] = grid.limits, limits = `${low} to ${high} p.u.`;
  const bus = /** @type {number[]} */ (moment.buses.id ?? grid.buses.id), vm = moment.buses.vm_pu ?? [];
  /** @type {Map<number, number>} */ const known = new Map();
  bus.forEach((id, k) => {
    if (typeof vm[k] === "number") known.set(id, vm[k]);
  });
  if (!known.size) return { title, state: "degraded", text: "No voltage is known.", offers: [] };
  const all = [...known], far = (/** @type {number} */ value) => Math.max(value - high, low - value);
  const outside = all.filter(([, value]) => far(value) > 0).sort(([, a], [, b]) => far(b) - far(a));
  if (outside.length) {
    const text = `${counted(outside.length, "bus")} outside ${limits}${more(outside.length)}`;
    return { title, state: "bad", text, offers: outside.slice(0, MOST_OFFERS).map(([id, value]) => offerBus(id, value)) };
  }
  const lowest = all.reduce((a, b) => (b[1] < a[1] ? b : a)), highest = all.reduce((a, b) => (b[1] > a[1] ? b : a));
  const unknown = new Set(grid.buses.id).size - known.size;
  const rest = unknown > 0 ? `; of ${counted(unknown, "bus")} it is not known` : "";
  return {
    title, state: unknown > 0 ? "degraded" : "good", text: `Within ${limits}${rest}; lowest and highest:`,
    offers: [offerBus(...lowest), offerBus(...highest)],
  };
}

/** @param {Moment} moment @returns {Tile} */
function findMeters({ meters, meter_counts: counts, view }) {
  const title = "Worst meter", worst = meters.meter?.[0], off = meters.normalised_residual?.[0];
  const removed = [...new Set(Object.values(view.areas).flatMap((area) => area.removed))];
  const said = REJECTED.filter((status) => counts[status]).map((status) => `${counts[status]} ${status}`).join(", ");
  /** @type {Offer[]} */ const offers = removed.slice(0, MOST_OFFERS - 1).map((id) => ({ label: `${id} is removed`, choice: { kind: "meter", id } }));
  if (typeof off === "number") offers.unshift({ label: String(worst), choice: { kind: "meter", id: String(worst) } });
  const text = typeof off === "number" ? `Normalised residual ${number(off, 3)}${said ? `; ${said}` : ""}:` : said ? `No residual is known; ${said}${removed.length ? ":" : "."}` : "No residual is known.";
  return { title, state: said ? "bad" : typeof off === "number" ? "good" : "degraded", text, offers };
}

/** @param {Moment} moment @returns {Tile} */
function findLinks(moment) {
  const title = "Links", { links } = moment, dead = findDeadLinks(moment), alive = links.filter((link) => link.alive).length;
  if (!links.length) return { title, state: "good", text: "No area has a neighbour.", offers: [] };
  const received = alive === links.length ? `All ${alive} directions work.` : `${alive} of ${links.length} directions work`;
  const words = dead.slice(0, MOST_OFFERS).map(({ text }) => text).join("; ");
  const rest = dead.length > MOST_OFFERS ? `; and ${dead.length - MOST_OFFERS} more` : "";
  const text = alive === links.length ? received : `${received}${words ? `: ${words}${rest}` : "; the others have not begun, or an area is gone"}.`;
  return { title, state: dead.length ? "bad" : alive < links.length ? "degraded" : "good", text, offers: [] };
}

/** @param {Moment} moment @returns {Tile} */
function findAreas({ view }) {
  const title = "Areas", areas = Object.entries(view.areas), rank = { bad: 0, degraded: 1, good: 2 };
  const classOf = (/** @type {string} */ quality) => /** @type {"good"|"degraded"|"bad"} */ (qualityClass(quality));
  const poor = areas.filter(([, area]) => area.quality !== "good")
    .sort(([, a], [, b]) => rank[classOf(a.quality)] - rank[classOf(b.quality)]);
  if (!areas.length) return { title, state: "bad", text: "Nobody is there.", offers: [] };
  if (!poor.length) return { title, state: "good", text: areas.length === 1 ? "The one area is good." : `All ${areas.length} are good.`, offers: [] };
  return {
    title, state: classOf(poor[0][1].quality), text: `${poor.length} of ${areas.length} not good${more(poor.length)}`,
    offers: poor.slice(0, MOST_OFFERS).map(([id, area]) => ({ label: `${id}: ${area.quality}`, choice: { kind: "area", id } })),
  };
}

/** @param {Moment} moment @param {Grid} grid @returns {Tile[]} */
export function findTiles(moment, grid) {
  return [findVoltages(moment, grid), findMeters(moment), findLinks(moment), findAreas(moment)];
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
    for (const [line, said] of /** @type {[Element, string][]} */ ([[heading, `${SIGNS[state]} ${title}`], [words, text]])) {
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
