/** Training curves by epoch and detector: quality (0 to 1) and losses. */

import { createCharts } from "../charts.js";

// precision and recall are in the table of models: four more lines would hide these
const QUALITY = /^map50(_95)?$/;
const LOSS = /loss$/;
/** @type {Record<string, string>} */
const NAMES = {
  map50: "mAP50",
  map50_95: "mAP50-95",
  box_loss: "box loss",
  cls_loss: "class loss",
  dfl_loss: "edge loss",
};

export function createCurves() {
  const chart =
    (/** @type {RegExp} */ names, /** @type {object} */ yaxis) =>
    (/** @type {Api.CurvePoint[]} */ points, /** @type {Colors} */ colors) => ({
      traces: traces(points, colors, (name) => names.test(name)),
      layout: { yaxis, xaxis: { title: { text: "epoch" }, rangemode: "tozero" } },
    });
  const { root, draw, destroy } = createCharts("div.charts", [
    ["Quality on validation pictures", "curves-quality", chart(QUALITY, { range: [0, 1.02] })],
    ["Training losses", "curves-losses", chart(LOSS, { rangemode: "tozero" })],
  ]);
  root.hidden = true;
  let drawn = "";

  return {
    root,
    destroy,
    show(/** @type {Api.CurvePoint[]} */ points) {
      root.hidden = points.length === 0;
      const key = JSON.stringify(points);
      if (key === drawn || points.length === 0) return;
      drawn = key;
      void draw(points);
    },
  };
}

function traces(
  /** @type {Api.CurvePoint[]} */ points,
  /** @type {Colors} */ colors,
  /** @type {(name: string) => boolean} */ wanted,
) {
  /** @type {Map<string, { role: Api.DetectorKind, name: string, x: number[], y: number[] }>} */
  const series = new Map();
  for (const { role, epoch, metrics } of points) {
    for (const [name, value] of Object.entries(metrics)) {
      if (!wanted(name) || value === null) continue;
      const key = `${role} ${name}`;
      const one = series.get(key) ?? { role, name, x: [], y: [] };
      one.x.push(epoch);
      one.y.push(value);
      series.set(key, one);
    }
  }
  const palette = {
    image: [colors.accent, colors.good, colors.muted],
    view: [colors.proposed, colors.bad, colors.text],
  };
  const used = { image: 0, view: 0 };
  return [...series.values()].map(({ role, name, x, y }) => ({
    x,
    y,
    name: `${role}: ${NAMES[name] ?? name}`,
    mode: x.length > 40 ? "lines" : "lines+markers",
    line: { color: palette[role][used[role]++ % 3], width: 1.6, dash: role === "view" ? "dot" : "solid" },
    marker: { size: 4 },
  }));
}
