"use strict";
// What all pages do: unpack the plotting library, draw plots in the colours of the theme, fill and sort tables.

const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0));
const unpacked = text => new Response(new Blob([bytes(text)]).stream().pipeThrough(new DecompressionStream("gzip")));
const element = (name, properties = {}, ...children) => {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
};
const content = id => JSON.parse(document.getElementById(id).textContent);

// ---- themes: colours are named in the stylesheet; plots write them as "var(--name)"
const inked = name => {
  const probe = document.body.appendChild(element("i", { style: `color: var(${name})` }));
  const color = getComputedStyle(probe).color;
  probe.remove();
  return color;
};
const themed = text => JSON.parse(text.replace(/"var\((--\w+)\)"/g, (_, name) => JSON.stringify(inked(name))));
const isDark = () => getComputedStyle(document.body).backgroundColor.match(/\d+/g)[0] < 128;
const drawers = []; // functions that draw again, called when the theme changes
const redraw = () => drawers.forEach(draw => draw());
document.getElementById("theme").addEventListener("click", () => {
  document.documentElement.style.colorScheme = isDark() ? "light" : "dark";
  redraw();
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);

// ---- plots
const CONFIG = { displaylogo: false, responsive: true, modeBarButtons: [["toImage"]], toImageButtonOptions: { scale: 2 } }; // and none that talks to a server
function plot(box) {
  const text = box.querySelector("script").textContent, stage = box.appendChild(element("div"));
  drawers.push(() => {
    const { data, layout } = themed(text);
    Plotly.react(stage, data, layout, { ...CONFIG, displayModeBar: layout.height > 200 });
  });
  drawers.at(-1)();
}
async function library() {
  const packed = document.getElementById("library");
  document.head.append(element("script", { textContent: await unpacked(packed.textContent).text() }));
  packed.remove();
}

// ---- tables: columns of values; sorted by a click on a head, filtered by words and comparisons
const ROWS = 50;
const written = (value, column) =>
  value === null ? "–" : typeof value === "number" ? (Number(value.toFixed(column.digits)) + 0).toLocaleString("en-US", { maximumFractionDigits: column.digits }) : String(value); // + 0: no "-0"
function condition(term, columns) {
  const [, name, sign, wanted] = term.match(/^(\w+)(>=|<=|!=|=|>|<)(.+)$/) ?? [];
  const column = columns.find(c => c.name === name);
  if (!column) return row => columns.some(c => String(c.values[row] ?? "").toLowerCase().includes(term));
  const number = Number(wanted);
  return row => {
    const value = column.values[row];
    if (sign === "=" || sign === "!=") return (String(value ?? "").toLowerCase() === wanted || value === number) === (sign === "=");
    return value !== null && { ">": value > number, "<": value < number, ">=": value >= number, "<=": value <= number }[sign];
  };
}
function table(box) {
  const columns = JSON.parse(box.querySelector("script").textContent);
  const input = box.querySelector("input"), count = box.querySelector("output"), more = box.querySelector(".more");
  const body = element("tbody"), heads = columns.map(column => {
    const button = element("button", { type: "button", textContent: column.title, title: column.about });
    button.addEventListener("click", () => { order = { column, down: order?.column === column ? !order.down : typeof column.values.find(v => v !== null) === "number" }; fill(); });
    return element("th", { className: typeof column.values.find(v => v !== null) === "string" ? "text" : "" }, button);
  });
  box.querySelector("table").append(element("thead", {}, element("tr", {}, ...heads)), body);
  let order = null, limit = ROWS;
  const cell = (column, row) => {
    const value = column.values[row], text = written(value, column);
    const made = element("td", { className: typeof value === "string" ? "text" : "" });
    made.append(column.link && column.linked.includes(value) ? element("a", { href: `#${column.link}${value}`, textContent: text }) : text);
    return made;
  };
  function fill() {
    const conditions = input.value.toLowerCase().split(/\s+/).filter(Boolean).map(term => condition(term, columns));
    const rows = [...columns[0].values.keys()].filter(row => conditions.every(holds => holds(row)));
    if (order) {
      const { values } = order.column, sign = order.down ? -1 : 1;
      rows.sort((a, b) => (values[a] === null) - (values[b] === null) || sign * (values[a] < values[b] ? -1 : values[a] > values[b] ? 1 : 0));
    }
    heads.forEach((head, i) => columns[i] === order?.column ? head.setAttribute("aria-sort", order.down ? "descending" : "ascending") : head.removeAttribute("aria-sort"));
    body.replaceChildren(...rows.slice(0, limit).map(row => element("tr", {}, ...columns.map(column => cell(column, row)))));
    count.textContent = `${rows.length.toLocaleString("en-US")} of ${columns[0].values.length.toLocaleString("en-US")}`;
    more.hidden = rows.length <= limit;
  }
  input.addEventListener("input", () => { limit = ROWS; fill(); });
  more.addEventListener("click", () => { limit *= 4; fill(); });
  fill();
}

document.querySelectorAll(".sortable").forEach(table);
library().then(() => {
  document.querySelectorAll(".plot").forEach(plot);
  document.dispatchEvent(new Event("plotting")); // for scripts that draw with the library
}).catch(error => {
  document.querySelectorAll(".plot, .stage").forEach(box => box.append(`Plots need a browser of 2024 or later (${error.message}).`));
  throw error;
});
