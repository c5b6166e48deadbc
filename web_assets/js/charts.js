/** Charts, drawn by plotly. Its script comes from the server and is loaded when the first chart is drawn. */

import { h } from "./dom.js";
import { messageOf } from "./errors.js";
import { onTheme } from "./colors.js";

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

/** A line through points. */
export const line = (/** @type {string} */ color, /** @type {object} */ trace, dash = "solid") => ({
  mode: "lines+markers",
  line: { color, width: 1.6, dash },
  marker: { size: 4 },
  ...trace,
});

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
  const names = "text muted line accent good warn bad proposed accepted edited rejected".split(" ");
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
 * Charts of the same data side by side, which follow the theme and their size.
 *
 * @template T
 * @param {"div.charts" | "div.charts.three"} tag
 * @param {[string, string | null, (data: T, colors: Colors) => Chart][]} figures title, test id, and what is drawn.
 */
export function createCharts(tag, figures) {
  const hosts = figures.map(([, testid]) => h("div.chart", { "data-testid": testid }));
  const root = h(
    tag,
    figures.map(([title], i) => h("figure", h("figcaption", title), hosts[i])),
  );
  /** @type {Plotly | null} */
  let plotly = null;
  let ended = false;
  /** What was drawn last. @type {[T] | null} */
  let shown = null;

  async function draw(/** @type {T} */ data) {
    shown = [data];
    try {
      plotly ??= await loadPlotly();
    } catch (error) {
      for (const host of hosts) host.textContent = `No chart: ${messageOf(error)}. The table has the same numbers.`;
      return;
    }
    if (ended || !root.isConnected) return;
    const colors = themeColors();
    for (const [i, [, , make]] of figures.entries()) void react(plotly, hosts[i], make(data, colors), colors);
  }

  const stop = onTheme(() => void (shown && draw(...shown)));

  return {
    root,
    draw,
    destroy() {
      ended = true;
      stop();
      for (const host of hosts) plotly?.purge(host);
    },
  };
}

function react(
  /** @type {Plotly} */ plotly,
  /** @type {HTMLElement} */ host,
  /** @type {Chart} */ { traces, layout },
  /** @type {Colors} */ colors,
) {
  const axis = { gridcolor: colors.line, zerolinecolor: colors.line, linecolor: colors.line, automargin: true };
  const base = {
    paper_bgcolor: "rgba(0,0,0,0)",
    plot_bgcolor: "rgba(0,0,0,0)",
    font: { family: "system-ui, sans-serif", size: 12, color: colors.text },
    margin: { l: 44, r: 10, t: 28, b: 34 },
    legend: { orientation: "h", x: 0, y: 1.02, yanchor: "bottom", font: { color: colors.muted, size: 11.5 } },
    hovermode: "closest",
    annotations: traces.some(hasValues) ? [] : [nothingYet(colors.muted)],
  };
  const full = { ...base, ...layout, xaxis: { ...axis, ...layout.xaxis }, yaxis: { ...axis, ...layout.yaxis } };
  return plotly.react(host, traces, full, { displayModeBar: false, responsive: true });
}

// -- numbers and tables

export const number = (/** @type {number | null | undefined} */ value, /** @type {number} */ digits = 1) =>
  value?.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits }) ?? "–";

/** A time: hours, or minutes below one hour. */
export function duration(/** @type {number | null | undefined} */ hours) {
  if (hours === null || hours === undefined) return "–";
  const minutes = Math.round(60 * hours);
  if (minutes >= 60) return `${number(hours)} h`;
  return minutes === 0 && hours > 0 ? "under 1 min" : `${minutes} min`;
}

export const percent = (/** @type {number | null | undefined} */ share) =>
  share === null || share === undefined ? "–" : `${number(100 * share, 0)} %`;

/** A panel with a table: its first column names the rows, the others have numbers. */
export function table(
  /** @type {string} */ title,
  /** @type {string} */ testid,
  /** @type {string[]} */ heads,
  /** @type {string[][]} */ rows,
) {
  const head = heads.map((text, i) => h("th", { scope: "col", class: i ? "number right" : "" }, text));
  const row = (/** @type {string[]} */ [name, ...cells]) =>
    h("tr", [h("th", { scope: "row" }, name), ...cells.map((cell) => h("td.number.right", cell))]);
  const shown = h("table.dense", { "data-testid": testid }, h("thead", h("tr", head)), h("tbody", rows.map(row)));
  return h("section.panel", h("header", h("h2", title)), h("div.scroll-x", shown));
}
