/** The page: takes what the server sends, and shows it. */

import { Alarms } from "./alarms.js";
import { CauseBanner } from "./cause.js";
import { Profile } from "./charts.js";
import { csvOf, keep } from "./csv.js";
import { Events } from "./events.js";
import { Feeder } from "./feeder.js";
import { byId, clock, nextPicture, when } from "./format.js";
import { findWorst, Glance } from "./glance.js";
import { Histories } from "./histories.js";
import { findDeadLinks } from "./links.js";
import { Playback } from "./playback.js";
import { Selected } from "./selected.js";
import { Tables } from "./tables.js";

/** @typedef {import("./types.js").Grid} Grid @typedef {import("./types.js").Moment} Moment */
/** @typedef {import("./types.js").Choice} Choice */

const SILENT_MS = 6000; // after which the server counts as gone
const AGAIN_MS = 1000; // until the server is asked once more when it has refused
const ZOOM = 1.6;
const MOST_OFFERED = 50; // buses and branches whose names begin as typed

/** @type {Moment | null} */ let moment = null; // the one that is shown
/** @type {Moment | null} */ let next = null; // the one to show after it
/** @type {Grid} */ let grid;
/** @type {Profile | null} */ let profile = null;
let isShowing = false;
let heardAt = 0;
const feeder = new Feeder(/** @type {HTMLCanvasElement} */ (byId("drawing")), /** @type {HTMLCanvasElement} */ (byId("print")), choose);
const glance = new Glance(choose);
const tables = new Tables(choose, ask, showAgain);
const selected = new Selected(ask, choose), histories = new Histories(ask);
const banner = new CauseBanner(), alarms = new Alarms(), events = new Events();
let isChosen = false; // by a person; until then the worst is selected

/** @param {string} path @returns {Promise<any>} */
async function ask(path) {
  const answer = await fetch(path);
  if (!answer.ok) throw new Error(`${path}: ${answer.status}`);
  return answer.json();
}

/** @param {Choice} wanted */
function choose(wanted) {
  isChosen = true;
  select(wanted);
  if (moment) selected.show(moment, grid);
  showAgain();
}

/** @param {Choice} wanted */
function select(wanted) {
  tables.choice = wanted;
  selected.choose(wanted);
  histories.choose(wanted);
  feeder.mark(isChosen ? wanted : null);
  byId("selected-title").textContent = isChosen ? "Selected" : "Selected: the worst";
}

/** Until somebody chooses. @param {Moment} found */
function selectWorst(found) {
  const worst = isChosen ? null : findWorst(found);
  if (worst && (worst.kind !== tables.choice?.kind || worst.id !== tables.choice.id)) select(worst);
}

/** What is shown, with what has been chosen since. */
function showAgain() {
  const shown = next ?? moment;
  if (shown) take(shown);
}

/** @param {Grid} found */
async function takeGrid(found) {
  grid = found;
  feeder.setGrid(grid);
  await nextPicture();
  profile?.destroy();
  profile = grid.known ? new Profile(grid) : null;
  byId("profile-section").hidden = !grid.known;
}

/**
 * Show `found`, or what is newer when its turn comes: one moment is shown after the other, each of them whole, and a
 * grid that has changed is asked for first.
 * @param {Moment} found
 */
async function take(found) {
  next = found;
  if (isShowing) return;
  isShowing = true;
  try {
    while (next) {
      const now = next;
      next = null;
      if (!now.view) continue;
      if (now.grid_version !== grid.version) await takeGrid(await ask("/api/grid").catch(() => grid));
      if (now.grid_version === grid.version) await show(now); // else the next one is on its way
    }
  } finally {
    isShowing = false;
  }
}

/** Part after part, so that nobody who types or clicks waits for all of them. @param {Moment} found */
async function show(found) {
  moment = found;
  document.body.classList.toggle("by-phase", found.summary.has_phases);
  selectWorst(found);
  const parts = [
    showStatus, () => alarms.show(found), () => glance.show(found, grid), () => feeder.show(found), () => selected.show(found, grid),
    () => histories.take(found), () => profile?.show(found), () => tables.show(found), () => events.show(found),
  ];
  for (const part of parts) {
    await part();
    await nextPicture();
  }
  document.body.dataset.moment = String(found.number); // all of it is shown
}

/** @param {import("./types.js").AreaView[]} areas @returns {string} whether anything arrives, in words */
function findSilence(areas) {
  const isSilent = areas.length > 0 && areas.every(({ present, silent }) => silent || !present), ages = areas.flatMap(({ age_s: age }) => age ?? []);
  return isSilent && ages.length ? `Nothing received for ${Math.min(...ages).toFixed(0)} s` : "Live";
}

function showStatus() {
  if (!moment?.view) return;
  const areas = Object.values(moment.view.areas), counts = new Map();
  for (const area of areas) counts.set(area.quality, (counts.get(area.quality) ?? 0) + 1);
  const words = [...counts].map(([quality, n]) => `${n} ${quality}`).join(", ");
  const strangers = moment.view.strangers ? [`${moment.view.strangers} more that are announced as areas are not shown`] : [];
  const remarks = [...strangers, ...moment.view.duplicates, ...moment.view.other_versions].join("; ");
  byId("time").textContent = moment.mode === "playback" ? `Playback at ${when(moment, moment.at)}.` : `${findSilence(areas)}, ${clock(moment.time)}.`;
  const lost = moment.mode === "live" && performance.now() - heardAt > SILENT_MS;
  const text = lost ? `The server has sent nothing since ${clock(moment.time)}.` : `${areas.length} areas: ${words || "nobody is there"}. ${remarks}`.trim();
  byId("title").textContent = `${grid.title === moment.view.run ? "" : `${grid.title}: `}run ${moment.view.run}`;
  const status = byId("status");
  status.className = lost ? "lost" : "";
  if (status.textContent !== text) status.textContent = text;
  banner.show(moment, lost ? moment.time : null);
  const dead = findDeadLinks(moment).map((link) => `; ${link.text}`).join("");
  feeder.canvas.setAttribute("aria-label", `The feeder with ${grid.buses.id.length} buses; ${areas.length} areas: ${words}${dead}. The tables below have the same.`);
}

/** Charts in the colours that hold now. */
function repaint() {
  profile?.repaint();
  histories.repaint();
}

/** Paper is light, whatever the screen is. @param {boolean} isPrinting */
function showPrint(isPrinting) {
  document.documentElement.classList.toggle("printing", isPrinting);
  if (isPrinting) feeder.paintPrint();
  else feeder.repaint();
  repaint();
}

function listen() {
  const stream = new EventSource("/api/stream");
  stream.onmessage = (event) => {
    heardAt = performance.now();
    take(JSON.parse(event.data));
  };
  stream.addEventListener("pulse", () => {
    heardAt = performance.now();
  });
  stream.onerror = () => {
    if (stream.readyState !== EventSource.CLOSED) return; // the browser tries again by itself
    stream.close();
    setTimeout(listen, AGAIN_MS);
  };
}

byId("find").addEventListener("submit", (event) => {
  event.preventDefault();
  const what = /** @type {HTMLInputElement} */ (byId("what")), id = what.value.trim();
  if (grid.buses.id.some((bus) => String(bus) === id)) choose({ kind: "bus", id });
  else if (grid.branches.id.includes(id)) choose({ kind: "branch", id });
  else {
    what.setCustomValidity(id ? "There is no bus and no branch of this name." : "Write the number of a bus, or the name of a branch.");
    what.reportValidity();
  }
});
byId("what").addEventListener("input", () => {
  const what = /** @type {HTMLInputElement} */ (byId("what")), typed = what.value.trim();
  what.setCustomValidity("");
  const found = [...grid.buses.id.map(String), ...grid.branches.id].filter((name) => name.startsWith(typed));
  byId("things").replaceChildren(...found.slice(0, MOST_OFFERED).map((name) => {
    const option = document.createElement("option");
    option.value = name;
    return option;
  }));
});
byId("events-csv").addEventListener("click", () => {
  if (moment) keep("events.csv", csvOf(["time", "area", "kind", "text"], events.pick(moment).map(({ time, area, kind, text }) => [time, area, kind, text])));
});
byId("nearer").addEventListener("click", () => feeder.scale(ZOOM));
byId("farther").addEventListener("click", () => feeder.scale(1 / ZOOM));
byId("whole").addEventListener("click", () => feeder.reset());
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", repaint);
window.addEventListener("beforeprint", () => showPrint(true));
window.addEventListener("afterprint", () => showPrint(false));

grid = await ask("/api/grid");
await takeGrid(grid);
if (grid.mode === "playback") {
  await new Playback(ask, take).start();
} else {
  listen();
  setInterval(showStatus, 1000);
}
