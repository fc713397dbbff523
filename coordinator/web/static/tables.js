/** Areas, meters, messages and events as tables; rows are reused, so that nothing flickers and focus stays. */

import { byId, element, nextPicture, number, qualityClass, when } from "./format.js";

/** @typedef {import("./types.js").AreaView} AreaView @typedef {import("./types.js").Moment} Moment @typedef {import("./types.js").Choice} Choice */

const FINE = ["used", "critical", "not received"];
const MOST_METERS = 100;
const MOST_EVENTS = 60;
const MOST_AREAS = 200;
const SLICE = 25; // rows that are laid out at once

/**
 * Where there are very many: those that are not good, then good ones, then those that have never said anything.
 * @param {[string, AreaView][]} areas @returns {[string, AreaView][]}
 */
function chooseAreas(areas) {
  if (areas.length <= MOST_AREAS) return areas;
  const rank = (/** @type {AreaView} */ area) => (area.age_s === null ? 2 : area.quality === "good" ? 1 : 0);
  return [...areas].sort(([, one], [, other]) => rank(one) - rank(other)).slice(0, MOST_AREAS);
}

export class Rows {
  /**
   * @param {string} id of the table @param {string} caption
   * @param {{title: string, number?: boolean}[]} columns
   */
  constructor(id, caption, columns) {
    const table = byId(id), head = document.createElement("tr");
    table.replaceChildren(element("caption", caption), element("thead"), element("tbody"));
    for (const column of columns) {
      const cell = element("th", column.title, column.number ? "number" : "");
      cell.setAttribute("scope", "col");
      head.append(cell);
    }
    /** @type {HTMLElement} */ (table.querySelector("thead")).append(head);
    this.body = /** @type {HTMLElement} */ (table.querySelector("tbody"));
    this.columns = columns;
  }

  /**
   * @param {{cells: string[], className?: string, choose?: () => void, chosen?: boolean}[]} rows
   * whose first cell is a button where a row can be chosen
   */
  async show(rows) {
    while (this.body.children.length > rows.length) this.body.lastElementChild?.remove();
    for (const [k, row] of rows.entries()) {
      if (k && k % SLICE === 0) await nextPicture();
      const line = /** @type {HTMLTableRowElement} */ (this.body.children[k] ?? this.add());
      line.className = row.chosen ? "chosen" : "";
      row.cells.forEach((text, c) => {
        const cell = line.cells[c];
        if (c === 0 && row.choose) {
          let button = /** @type {HTMLButtonElement | null} */ (cell.querySelector("button"));
          if (!button) {
            button = /** @type {HTMLButtonElement} */ (element("button"));
            button.type = "button";
            cell.replaceChildren(button);
          }
          if (button.textContent !== text) button.textContent = text;
          button.onclick = row.choose;
        } else if (cell.textContent !== text) {
          cell.textContent = text;
        }
        if (c === 1 && row.className !== undefined && cell.className !== row.className) cell.className = row.className;
      });
    }
  }

  add() {
    const line = document.createElement("tr");
    for (const column of this.columns) line.append(element("td", "", column.number ? "number" : ""));
    this.body.append(line);
    return line;
  }
}

export class Tables {
  /** @param {(choice: Choice) => void} choose */
  constructor(choose) {
    this.choose = choose;
    /** @type {Choice | null} */ this.choice = null;
    this.events = "";
    this.areas = new Rows("areas", "What each area says of its estimate, and why.", [
      { title: "Area" }, { title: "Quality" }, { title: "Scan", number: true }, { title: "Age s", number: true },
      { title: "Voltage p.u." }, { title: "Worst normalised residual" }, { title: "Exchanges", number: true },
      { title: "Messages", number: true }, { title: "Lost", number: true }, { title: "Why" },
    ]);
    this.meters = new Rows("meters", "Readings and estimates, the farthest off first.", [
      { title: "Meter" }, { title: "Status" }, { title: "Area" }, { title: "Reading", number: true },
      { title: "Estimate", number: true }, { title: "Unit" }, { title: "Normalised residual", number: true },
      { title: "Age s", number: true },
    ]);
    this.messages = new Rows("messages", "Messages on their way at this moment.", [
      { title: "From" }, { title: "To" }, { title: "Kind" }, { title: "Sent s", number: true }, { title: "What became of it" },
    ]);
  }

  /** @param {Moment} moment */
  async show(moment) {
    const is = (/** @type {string} */ kind, /** @type {string} */ id) => this.choice?.kind === kind && this.choice.id === id;
    const areas = Object.entries(moment.view.areas);
    await this.areas.show(chooseAreas(areas).map(([name, area]) => ({
      cells: [
        name, area.quality, String(area.scan), number(area.age_s, 3),
        area.lowest_vm && area.highest_vm ? `${number(area.lowest_vm.value, 4)} to ${number(area.highest_vm.value, 4)}` : "-",
        area.worst_meter ? `${area.worst_meter.at} ${number(area.worst_meter.value, 2)}` : "-",
        String(area.exchanges), String(area.messages), String(area.lost), area.notes.join("; "),
      ],
      className: qualityClass(area.quality),
      choose: () => this.choose({ kind: "area", id: name }),
      chosen: is("area", name),
    })));
    await nextPicture();
    await this.showMeters(moment.meters, is);
    await this.messages.show(moment.messages.map((m) => ({
      cells: [m.from, m.to, m.kind, number(m.sent, 6), m.lost ? "lost" : m.arrived === null ? "on its way" : `arrived at ${number(m.arrived, 6)} s`],
    })));
    byId("messages-section").hidden = !moment.has_messages;
    this.showEvents(moment);
  }

  /** The list is left alone while nothing new is in it, so that who reads or scrolls it can. @param {Moment} moment */
  showEvents(moment) {
    const newest = moment.events.slice(-MOST_EVENTS).reverse();
    const lines = newest.map((event) => `${when(moment, event.time)} ${event.area} ${event.text}`);
    const all = lines.join("\n");
    if (all === this.events) return;
    this.events = all;
    byId("events").replaceChildren(...lines.map((line) => element("li", line)));
  }

  /** @param {import("./types.js").Columns} meters @param {(kind: string, id: string) => boolean} is */
  async showMeters(meters, is) {
    const count = meters.meter?.length ?? 0, off = /** @type {(number|null)[]} */ (meters.normalised_residual ?? []);
    const order = [...Array(count).keys()].sort((a, b) => Math.abs(off[b] ?? -1) - Math.abs(off[a] ?? -1) || a - b);
    const of = (/** @type {string} */ word) => (meters.status ?? []).filter((status) => status === word).length;
    const awaited = of("not received");
    byId("meters-note").textContent = count
      ? `${count} meters, ${of("silent")} silent${awaited ? `, ${awaited} not received yet` : ""}${count > MOST_METERS ? `; the first ${MOST_METERS} are shown` : ""}` : "No readings are known.";
    await this.meters.show(order.slice(0, MOST_METERS).map((k) => ({
      cells: [
        String(meters.meter[k]), String(meters.status[k]), String(meters.area[k]), number(/** @type {number} */ (meters.reading[k])),
        number(/** @type {number} */ (meters.estimate[k])), String(meters.unit?.[k] ?? "p.u., rad"), number(off[k], 3), number(/** @type {number} */ (meters.age_s[k]), 3),
      ],
      className: FINE.includes(String(meters.status[k])) ? "" : "bad",
      choose: () => this.choose({ kind: "meter", id: String(meters.meter[k]) }),
      chosen: is("meter", String(meters.meter[k])),
    })));
  }
}
