/** A table whose rows are reused, so that nothing flickers and focus stays. */

import { csvOf } from "./csv.js";
import { byId, element, nextPicture } from "./format.js";

const SLICE = 25; // rows that are laid out at once

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
    /** @type {string[][]} */ this.shown = [];
  }

  /**
   * @param {{cells: string[], className?: string, choose?: () => void, chosen?: boolean, old?: boolean}[]} rows
   * whose first cell is a button where a row can be chosen; `old`: its values are not of now
   */
  async show(rows) {
    this.shown = rows.map(({ cells }) => cells);
    while (this.body.children.length > rows.length) this.body.lastElementChild?.remove();
    for (const [k, row] of rows.entries()) {
      if (k && k % SLICE === 0) await nextPicture();
      const line = /** @type {HTMLTableRowElement} */ (this.body.children[k] ?? this.add());
      line.className = `${row.chosen ? "chosen" : ""} ${row.old ? "old" : ""}`.trim();
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
        const look = `${this.columns[c].number ? "number" : ""} ${c === 1 ? row.className ?? "" : ""} ${text === "-" || text === "" ? "empty" : ""}`.trim();
        if (cell.className !== look) cell.className = look;
      });
    }
  }

  add() {
    const line = document.createElement("tr");
    for (const column of this.columns) {
      const cell = element("td");
      cell.dataset.title = column.title; // where a row is a card
      line.append(cell);
    }
    this.body.append(line);
    return line;
  }

  /** @returns {string} as it is shown */
  csv() {
    return csvOf(this.columns.map(({ title }) => title), this.shown.map((cells) => cells.map((text) => (text === "-" ? "" : text))));
  }
}
