/** Charts, drawn by plotly. Its script comes from the server and is loaded when the first chart is drawn. */

import { onTheme } from "./colors.js";
import { h } from "./dom.js";
import { messageOf } from "./errors.js";

const SCRIPT = "/assets/vendor/plotly.min.js";

/** @type {Promise<Plotly> | null} */
let loading = null;

function loadPlotly() {
  loading ??= new Promise((resolve, reject) => {
    const script = document.createElement("script");
    script.src = SCRIPT;
    script.onload = () =>
      window.Plotly ? resolve(window.Plotly) : reject(new Error("the chart library failed to start"));
    script.onerror = () => reject(new Error("the chart library could not be loaded"));
    document.head.append(script);
  }).catch((error) => {
    loading = null;
    throw error;
  });
  return loading;
}

/** A name as a chart shows it: plotly takes some HTML. */
export const plain = (/** @type {string} */ name) =>
  name.replaceAll("&", "&amp;").replaceAll("<", "&lt;").replaceAll(">", "&gt;");

/** The theme's current colours: the computed colour of a probe element is the resolved CSS variable. */
function themeColors() {
  const probe = document.createElement("i");
  document.body.append(probe);
  const read = (/** @type {string} */ name) => {
    probe.style.color = `var(--${name})`;
    return getComputedStyle(probe).color;
  };
  const names = [
    "text",
    "muted",
    "line",
    "accent",
    "good",
    "warn",
    "bad",
    "proposed",
    "accepted",
    "edited",
    "rejected",
  ];
  const colors = Object.fromEntries(names.map((name) => [name, read(name)]));
  probe.remove();
  return colors;
}

const hasValues = (/** @type {{ x?: unknown, y?: unknown }} */ { x, y }) =>
  [x, y].every((list) => Array.isArray(list) && list.some((value) => value !== null));

const nothingYet = (/** @type {string} */ color) => ({
  text: "nothing measured yet",
  font: { color },
  showarrow: false,
  ...{ xref: "paper", yref: "paper", x: 0.5, y: 0.5 },
});

/**
 * A chart in `host` that follows the theme and the size of the host.
 *
 * @param {HTMLElement} host
 * @param {(colors: Record<string, string>) => Chart} make is called again at each draw.
 * @returns {{draw(): Promise<void>, destroy(): void}}
 */
export function createChart(host, make) {
  /** @type {Plotly | null} */
  let plotly = null;
  let ended = false;

  async function draw() {
    try {
      plotly ??= await loadPlotly();
    } catch (error) {
      host.textContent = `No chart: ${messageOf(error)}. The table has the same numbers.`;
      return;
    }
    if (ended || !host.isConnected) return;
    const colors = themeColors();
    const { traces, layout } = make(colors);
    const axis = { gridcolor: colors.line, zerolinecolor: colors.line, linecolor: colors.line, automargin: true };
    const base = {
      paper_bgcolor: "rgba(0,0,0,0)",
      plot_bgcolor: "rgba(0,0,0,0)",
      font: { family: "system-ui, sans-serif", size: 12, color: colors.text },
      margin: { l: 44, r: 10, t: 28, b: 34 },
      legend: { orientation: "h", x: 0, y: 1.02, yanchor: "bottom", font: { color: colors.muted, size: 11.5 } },
      hovermode: "closest",
    };
    const full = { ...base, ...layout, xaxis: { ...axis, ...layout.xaxis }, yaxis: { ...axis, ...layout.yaxis } };
    if (!traces.some(hasValues)) Object.assign(full, { annotations: [nothingYet(colors.muted)] });
    await plotly.react(host, traces, full, { displayModeBar: false, responsive: true });
  }

  const stop = onTheme(() => void draw());

  return {
    draw,
    destroy() {
      ended = true;
      stop();
      plotly?.purge(host);
    },
  };
}

// -- numbers and tables

export const number = (/** @type {number | null | undefined} */ value, /** @type {number} */ digits = 1) =>
  value === null || value === undefined
    ? "–"
    : value.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits });
/** A time: hours, or minutes below one hour. */
export function duration(/** @type {number | null | undefined} */ hours) {
  if (hours === null || hours === undefined) return "–";
  const minutes = Math.round(60 * hours);
  if (minutes >= 60) return `${number(hours)} h`;
  return minutes === 0 && hours > 0 ? "under 1 min" : `${minutes} min`;
}
export const percent = (/** @type {number | null | undefined} */ value) =>
  value === null || value === undefined ? "–" : `${number(100 * value, 0)} %`;
export function section(/** @type {string} */ title, /** @type {HTMLElement} */ table) {
  return h("section", { class: "panel" }, h("header", {}, h("h2", {}, title)), h("div", { class: "scroll-x" }, table));
}

export function table(/** @type {string[]} */ heads, /** @type {string[][]} */ rows, /** @type {string} */ testid) {
  return h(
    "table",
    { class: "dense", "data-testid": testid },
    h(
      "thead",
      {},
      h(
        "tr",
        {},
        heads.map((text, i) => h("th", { scope: "col", class: i ? "number right" : "" }, text)),
      ),
    ),
    h(
      "tbody",
      {},
      rows.map((cells) =>
        h(
          "tr",
          {},
          cells.map((cell, i) => (i ? h("td", { class: "number right" }, cell) : h("th", { scope: "row" }, cell))),
        ),
      ),
    ),
  );
}
