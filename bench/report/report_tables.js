// Sorting: a click on a header orders its table by that column, a second click the other way round.
function sortKey(row, column) {
  const cell = row.cells[column];
  return cell.dataset.value === undefined ? cell.textContent : toNumber(cell.dataset.value);
}

function toNumber(text) {
  return text === "inf" ? Infinity : text === "-inf" ? -Infinity : Number(text);
}

// Numbers come before words; empty cells and NaN stay last either way.
function compareKeys(a, b, sign) {
  const isLast = (key) => key === "" || Number.isNaN(key);
  if (isLast(a) || isLast(b)) return isLast(a) - isLast(b);
  if (typeof a !== typeof b) return typeof a === "number" ? -1 : 1;
  if (typeof a === "string") return sign * a.localeCompare(b, undefined, { numeric: true });
  return a === b ? 0 : a < b ? -sign : sign;
}

function sortBy(header) {
  const table = header.closest("table");
  const body = table.tBodies[0];
  const ascending = header.getAttribute("aria-sort") !== "ascending";
  for (const other of header.parentNode.cells) other.removeAttribute("aria-sort");
  header.setAttribute("aria-sort", ascending ? "ascending" : "descending");
  const column = header.cellIndex;
  const rows = Array.from(body.rows);
  rows.sort((a, b) => compareKeys(sortKey(a, column), sortKey(b, column), ascending ? 1 : -1));
  body.append(...rows);
}

for (const button of document.querySelectorAll("thead button")) {
  button.addEventListener("click", () => sortBy(button.parentNode));
}
