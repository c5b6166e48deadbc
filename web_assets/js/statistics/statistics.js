/**
 * Statistics: the effort of a box, the quality of proposals, and the project's progress, as in `annotator stats
 * --json`.
 */

import { createCharts, duration, number, percent } from "../charts.js";
import { h, nothing, patch } from "../dom.js";
import { errorBox } from "../forms.js";
import { makeHash } from "../router.js";
import * as figures from "./figures.js";

/** How long to rest between two readings, relative to the time that one takes. */
const REST = 20;

/** @type {Mode["mount"]} */
export function mount(root, app, until) {
  const tiles = h("div.tiles", { "data-testid": "stats-tiles" });
  const tables = h("div.stack");
  const charts = createCharts("div.charts.three", [
    ["Boxes labelled per day", "work-days", figures.dayChart],
    ["Seconds per box, as work went on", "work-seconds", figures.paceChart("seconds_a_box", "accent")],
    ["Actions per box, as work went on", "work-actions", figures.paceChart("actions_a_box", "proposed")],
    ["Proposals, as work went on", "work-proposals", figures.trendChart],
    ["IoU of proposal and final box, by distance", "work-ranges", figures.rangeChart],
    ["What became of proposals, by class", "work-classes", figures.classChart],
  ]);
  const panel = h("section.panel", { hidden: true }, h("div.body", charts.root));
  const parts = [h("h1", "Statistics"), tiles, panel, tables];
  root.append(h("div.page.wide", { "data-testid": "statistics" }, parts));
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  let timer;
  let restsUntilMs = 0;

  async function load() {
    timer = undefined;
    const beganMs = performance.now();
    try {
      const known = await app.api.get(app.path("statistics"));
      if (!until.aborted) show(known);
    } catch (error) {
      if (!until.aborted) patch(tiles, errorBox(error));
    } finally {
      restsUntilMs = performance.now() + REST * (performance.now() - beganMs);
    }
  }

  function show(/** @type {Api.ReportedStatistics} */ known) {
    const isEmpty = known.labels.total === 0;
    const text = "The numbers are shown once objects are labelled or proposed.";
    const href = makeHash(app.state.route.project, "annotate");
    patch(tiles, tilesOf(known));
    patch(tables, isEmpty ? nothing("No boxes yet", text, href, "Annotate") : tablesOf(known));
    panel.hidden = known.progress.days.length === 0;
    if (!panel.hidden) void charts.draw(known.progress);
  }

  /** Reads the numbers again, not more often than the server can well compute them. */
  function loadSoon() {
    timer ??= setTimeout(load, Math.max(0, restsUntilMs - performance.now()));
  }

  app.events.on("frame", loadSoon, until);
  app.events.on("reconnected", loadSoon, until);
  until.addEventListener("abort", () => {
    clearTimeout(timer);
    charts.destroy();
  });
  void load();
}

function tilesOf(
  /** @type {Api.ReportedStatistics} */ { effort, accepted_untouched, iou_proposal_to_final, labels, progress },
) {
  const { earliest, latest } = progress.pace;
  const { hours_left, boxes_an_hour, frames_left, frames_done } = progress.forecast;
  const change =
    earliest && latest
      ? `of work: first ${number(earliest.seconds_a_box)}, lately ${number(latest.seconds_a_box)}`
      : "of work";
  const range = hours_left && `${duration(hours_left.low)} to ${duration(hours_left.high)}`;
  const left =
    frames_left === 0
      ? "every frame is done"
      : range && boxes_an_hour
        ? `${range}; lately ${number(boxes_an_hour.expected, 0)} boxes an hour`
        : `no forecast before 10 frames are done; ${number(frames_done, 0)} done, ${number(frames_left, 0)} left`;
  const done = (labels.by_state.accepted ?? 0) + (labels.by_state.edited ?? 0);
  return [
    ["Boxes done", number(done, 0), "accepted or edited"],
    ["Seconds per box", number(effort.seconds_a_box), change],
    ["Actions per box", number(effort.actions_a_box), "keys, clicks and drags that change something"],
    ["Accepted untouched", percent(accepted_untouched), "of the reviewed proposals"],
    ["Proposals", number(iou_proposal_to_final, 2), "mean 3D overlap (IoU) with the final box; 1 = same"],
    ["Work left", duration(hours_left?.expected), left],
  ].map(([name, value, help]) =>
    h("div.tile", h("div.tile-name", name), h("div.tile-value.number", value), h("div.muted", help)),
  );
}

function tablesOf(/** @type {Api.ReportedStatistics} */ known) {
  const { progress } = known;
  const { effortTable, stateTable, valueTables, projectTable } = figures;
  const common = [effortTable(known), stateTable(known), ...valueTables(known), projectTable(known)];
  if (progress.days.length === 0) return common;
  const { peopleTable, qualityTable, rangeTable, dayTable } = figures;
  return [peopleTable(progress), qualityTable(progress), rangeTable(progress), ...common, dayTable(progress)];
}
