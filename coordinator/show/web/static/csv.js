/** Tables as CSV, made and kept in the browser. */

/** @typedef {import("./types.js").Columns} Columns */

const FORMULA = /^[=+\-@\t\r]/; // what a spreadsheet would compute
const QUOTED = /[",\r\n]/;

/** @param {unknown} value @returns {string} a number with all its digits, a text that stays text, nothing where nothing is known */
function cellOf(value) {
  if (value === null || value === undefined) return "";
  if (typeof value === "number") return String(value);
  const text = FORMULA.test(String(value)) ? `'${value}` : String(value);
  return QUOTED.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
}

/** @param {string[]} header @param {unknown[][]} rows @returns {string} */
export function csvOf(header, rows) {
  return [header, ...rows].map((row) => `${row.map(cellOf).join(",")}\n`).join("");
}

/** @param {Columns} columns @returns {string} */
export function csvOfColumns(columns) {
  const names = Object.keys(columns), n = Math.max(0, ...names.map((name) => columns[name].length));
  return csvOf(names, Array.from({ length: n }, (_, k) => names.map((name) => columns[name][k])));
}

/** Have the browser keep `text` as a file. @param {string} name @param {string} text */
export function keep(name, text) {
  const link = document.createElement("a"), url = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
  link.href = url;
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(url));
}
