/** Training curves by epoch and detector: quality (0 to 1) and losses. */

import { createCharts, line } from "../charts.js";

// precision and recall are in the table of models: four more lines would hide these
const QUALITY = [
  ["map50", "mAP50"],
  ["map50_95", "mAP50-95"],
];
const LOSSES = [
  ["box_loss", "box loss"],
  ["cls_loss", "class loss"],
  ["dfl_loss", "edge loss"],
];
/** Names of the theme's colours. @type {[Api.DetectorKind, string[]][]} */
const PALETTES = [
  ["image", ["accent", "good", "muted"]],
  ["view", ["proposed", "bad", "text"]],
];

export function createCurves() {
  const chart =
    (/** @type {string[][]} */ metrics, /** @type {object} */ yaxis) =>
    (/** @type {Api.CurvePoint[]} */ points, /** @type {Colors} */ colors) => ({
      traces: PALETTES.flatMap(([role, palette]) =>
        metrics.flatMap(([metric, name], i) => {
          const own = points.filter((point) => point.role === role && (point.metrics[metric] ?? null) !== null);
          const x = own.map(({ epoch }) => epoch);
          const y = own.map(({ metrics: measured }) => measured[metric]);
          const trace = { x, y, name: `${role}: ${name}`, mode: x.length > 40 ? "lines" : "lines+markers" };
          return own.length ? [line(colors[palette[i]], trace, role === "view" ? "dot" : "solid")] : [];
        }),
      ),
      layout: { yaxis, xaxis: { title: { text: "epoch" }, rangemode: "tozero" } },
    });
  const { root, draw, destroy } = createCharts("div.charts", [
    ["Quality on validation pictures", "curves-quality", chart(QUALITY, { range: [0, 1.02] })],
    ["Training losses", "curves-losses", chart(LOSSES, { rangemode: "tozero" })],
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
