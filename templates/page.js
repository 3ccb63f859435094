// Shows the values at the pointer in charts, and the reason for the structure of an entry of M.
"use strict";
document.documentElement.classList.add("script");
for (const chart of document.querySelectorAll("svg.chart[data-x]")) {
  const axis = (name) => {
    const [start, end, low, high, log] = chart.dataset[name].split(" ").map(Number);
    return (pixel) => {
      const part = (pixel - start) / (end - start);
      return part < 0 || part > 1 ? null : log ? low * (high / low) ** part : low + part * (high - low);
    };
  };
  const x = axis("x"), y = axis("y");
  const text = document.createElementNS("http://www.w3.org/2000/svg", "text");
  text.setAttribute("class", "reading");
  text.setAttribute("text-anchor", "end");
  chart.addEventListener("pointermove", (event) => {
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(chart.getScreenCTM().inverse());
    const a = x(point.x), b = y(point.y);
    if (a === null || b === null) return text.remove();
    const [start, end] = chart.dataset.x.split(" ").map(Number);
    text.setAttribute("x", end);
    text.setAttribute("y", 20);
    text.textContent = `${Number(a.toPrecision(3))}, ${Number(b.toPrecision(3))}`;
    chart.append(text);
  });
  chart.addEventListener("pointerleave", () => text.remove());
}
const cells = [...document.querySelectorAll(".matrix td[data-row]")];
const entry = document.getElementById("entry");
const size = Math.sqrt(cells.length);
for (const cell of cells) {
  const row = Number(cell.dataset.row), column = Number(cell.dataset.column);
  const show = () => {
    for (const other of cells) {
      other.classList.toggle("lit", other === cell);
      other.tabIndex = other === cell ? 0 : -1;
    }
    if (entry) entry.textContent = cell.dataset.told;
    if (typeof arm !== "undefined" && arm) arm.light([row, column, ...JSON.parse(cell.dataset.joints)]);
  };
  const leave = () => {
    cell.classList.remove("lit");
    if (typeof arm !== "undefined" && arm) arm.light(null);
  };
  cell.tabIndex = row + column === 0 ? 0 : -1;
  cell.addEventListener("focus", show);
  cell.addEventListener("blur", leave);
  cell.addEventListener("pointerenter", show);
  cell.addEventListener("pointerleave", leave);
  cell.addEventListener("keydown", (event) => {
    const moved = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0] }[event.key];
    if (!moved) return;
    const next = cells[(row + moved[0]) * size + column + moved[1]];
    if (next && column + moved[1] >= 0 && column + moved[1] < size) next.focus();
    event.preventDefault();
  });
}
