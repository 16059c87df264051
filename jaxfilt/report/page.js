// Sorts a table by the column whose header was pressed; again: the other way. What is unknown stays last.
"use strict";
for (const button of document.querySelectorAll("thead button")) {
  button.addEventListener("click", () => {
    const header = button.closest("th");
    const body = header.closest("table").tBodies[0];
    const up = header.getAttribute("aria-sort") !== "ascending";
    for (const other of header.parentNode.children) other.setAttribute("aria-sort", "none");
    header.setAttribute("aria-sort", up ? "ascending" : "descending");
    const key = (row) => row.cells[header.cellIndex].dataset;
    const compare = (a, b) => {
      const [x, y] = [key(a), key(b)];
      if (x.none !== undefined || y.none !== undefined) return (x.none !== undefined) - (y.none !== undefined);
      const order = x.number !== undefined && y.number !== undefined
        ? Number(x.number) - Number(y.number)
        : (x.text ?? "").localeCompare(y.text ?? "");
      return up ? order : -order;
    };
    body.append(...[...body.rows].sort(compare));
  });
}
