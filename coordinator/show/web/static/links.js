/** Which links between areas are dead, in words. No document, no canvas. */

import { entryOf } from "./format.js";

/** @typedef {import("./types.js").Moment} Moment @typedef {Moment["links"]} Links */
/** @typedef {{receiver: string, sender: string, text: string}} DeadLink */

/**
 * Whom each area receives from, as a cell of a table.
 * @param {Links} links @returns {Map<string, string>}
 */
export function countReceived(links) {
  /** @type {Map<string, {count: number, dead: string[]}>} */ const found = new Map();
  for (const { from, to, alive } of links) {
    const of = found.get(to) ?? { count: 0, dead: [] };
    found.set(to, of);
    of.count += 1;
    if (!alive) of.dead.push(from);
  }
  return new Map([...found].map(([area, { count, dead }]) =>
    [area, `${count - dead.length} of ${count}${dead.length ? `: nothing from ${dead.join(", ")}` : ""}`]));
}

/**
 * Links over which nothing is received though both ends are there and the receiver has an estimate: where one is gone,
 * its own name says so, and before the first estimate a link may not have begun. One for both directions where both are
 * dead.
 * @param {Moment} moment @returns {DeadLink[]}
 */
export function findDeadLinks({ links, view }) {
  const isThere = (/** @type {string} */ name) => {
    const area = entryOf(view.areas, name);
    return Boolean(area?.present && !area.silent);
  };
  const dead = links.filter((link) => !link.alive && isThere(link.from) && isThere(link.to) && view.areas[link.to].estimated);
  const pairs = new Set(dead.map((link) => JSON.stringify([link.from, link.to])));
  return dead.flatMap(({ from, to }) => {
    if (!pairs.has(JSON.stringify([to, from]))) return [{ receiver: to, sender: from, text: `nothing from ${from} to ${to}` }];
    return from < to ? [{ receiver: to, sender: from, text: `nothing between ${from} and ${to}` }] : [];
  });
}
