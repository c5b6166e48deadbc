/**
 * Statistics: the effort of a box, the quality of proposals, and the project's progress, as in `annotator stats
 * --json`.
 */

import { createCharts, duration, number, percent, table } from "../charts.js";
import { STATES } from "../colors.js";
import { count, h, nothing, patch } from "../dom.js";
import { errorBox } from "../forms.js";
import { makeHash } from "../router.js";
import { createWork, dayTable, peopleTable, qualityTable, rangeTable } from "./work.js";

/** How long to rest between two readings, relative to the time that one takes. */
const REST = 20;
/** Values of an attribute that are listed. */
const MOST_VALUES = 12;
/** Characters of a value that are shown. */
const MOST_CHARACTERS = 40;
/** Listed even without boxes: these compare proposals with drawing from scratch. */
const ALWAYS = ["proposal accepted untouched", "proposal edited", "from nothing"];

/** @type {Mode["mount"]} */
export function mount(root, app, until) {
  const tiles = h("div.tiles", { "data-testid": "stats-tiles" });
  const tables = h("div.stack");
  const charts = createCharts("div.charts.three", [
    ["Seconds per box, by origin", null, effortChart("seconds_a_box", "accent")],
    ["Actions per box", null, effortChart("actions_a_box", "proposed")],
    ["Boxes by class and state", null, stateChart],
  ]);
  const chartsPanel = h("section.panel", h("div.body", charts.root));
  const work = createWork();
  root.append(
    h(
      "div.page.wide",
      { "data-testid": "statistics" },
      h("h1", "Statistics"),
      tiles,
      work.element,
      chartsPanel,
      tables,
    ),
  );
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
    chartsPanel.hidden = isEmpty;
    work.show(known.progress);
    void charts.draw(known);
  }

  /** Reads the numbers again, not more often than the server can well compute them. */
  function loadSoon() {
    timer ??= setTimeout(load, Math.max(0, restsUntilMs - performance.now()));
  }

  app.events.on("frame", loadSoon, until);
  app.events.on("reconnected", loadSoon, until);
  until.addEventListener("abort", () => {
    clearTimeout(timer);
    work.destroy();
    charts.destroy();
  });
  void load();
}

const originName = (/** @type {string} */ name) => `${name[0].toUpperCase()}${name.slice(1)}`;

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
  const common = [effortTable(known), countTable(known), ...valueTable(known), projectTable(known)];
  if (progress.days.length === 0) return common;
  return [peopleTable(progress), qualityTable(progress), rangeTable(progress), ...common, dayTable(progress)];
}

function effortTable(/** @type {Api.ReportedStatistics} */ { effort }) {
  const shown = Object.entries(effort.by_origin).filter(([name, entry]) => entry.boxes > 0 || ALWAYS.includes(name));
  const rows = shown.map(([name, entry]) => [
    originName(name),
    number(entry.boxes, 0),
    number(entry.seconds_a_box),
    number(entry.actions_a_box),
  ]);
  rows.push(["All", number(effort.boxes, 0), number(effort.seconds_a_box), number(effort.actions_a_box)]);
  return table("Effort per box", "stats-effort", ["Origin", "Boxes", "Seconds per box", "Actions per box"], rows);
}

function countTable(/** @type {Api.ReportedStatistics} */ { labels }) {
  const classes = labels.by_class_and_state ?? null;
  const of = (/** @type {Record<string, number>} */ states) => STATES.map((state) => number(states[state] ?? 0, 0));
  const all = number(labels.total, 0);
  if (!classes) {
    const counts = of(labels.by_state);
    const rows = [...STATES.map((state, i) => [state, counts[i]]), ["All", all]];
    return table("Boxes by state", "stats-states", ["State", "Boxes"], rows);
  }
  const sum = (/** @type {Record<string, number>} */ states) =>
    Object.values(states).reduce((total, value) => total + value, 0);
  const rows = Object.entries(classes).map(([name, states]) => [name, ...of(states), number(sum(states), 0)]);
  rows.push(["All", ...of(labels.by_state), all]);
  return table("Boxes by class and state", "stats-states", ["Class", ...STATES, "All"], rows);
}

function valueTable(/** @type {Api.ReportedStatistics} */ { attributes, without_value }) {
  const rows = Object.entries(attributes).map(([name, values]) => [
    name,
    valueList(values),
    number(without_value[name] ?? 0, 0),
  ]);
  const heads = ["Attribute", "Values", "Without a value"];
  return rows.length ? [table("Values of attributes", "stats-attributes", heads, rows)] : [];
}

const shortened = (/** @type {string} */ value) =>
  value.length > MOST_CHARACTERS ? `${value.slice(0, MOST_CHARACTERS - 1)}…` : value;

/** The values with their numbers, the most frequent first. */
function valueList(/** @type {Record<string, number>} */ values) {
  // objects list keys like "3" in their own order
  const entries = Object.entries(values).sort(([, a], [, b]) => b - a);
  const texts = entries.slice(0, MOST_VALUES).map(([value, times]) => `${shortened(value)}: ${number(times, 0)}`);
  if (entries.length > MOST_VALUES) texts.push(count(entries.length - MOST_VALUES, "other value"));
  return texts.join(", ") || "none";
}

function projectTable(/** @type {Api.ReportedStatistics} */ known) {
  /** @type {[string, number][]} */
  const rows = [
    ["Recordings", known.recordings],
    ["Frames", known.frames],
    ["Frames with labels", known.frames_with_labels],
    ["Frames with open proposals", known.frames_with_proposals],
    ["Frames finalised", known.frames_finalised],
    ["Frames that failed", known.frames_failed],
    ["2D boxes on images", known.image_boxes.boxes],
    ["2D boxes on views", known.view_boxes.boxes],
    ["Models", known.models],
    ...Object.entries(known.suggested).flatMap(([detector, { as_suggested, corrected }]) => [
      /** @type {[string, number]} */ ([`Boxes accepted as suggested by ${detector}`, as_suggested]),
      /** @type {[string, number]} */ ([`Boxes suggested by ${detector} and corrected`, corrected]),
    ]),
  ];
  const counted = rows.map(([name, value]) => [name, number(value, 0)]);
  const detector = ["View detector in use", known.view_detector ?? "none"];
  return table("The project", "stats-project", ["What", "Number"], [...counted, detector]);
}

/** The effort of a box by the origin of boxes. */
function effortChart(/** @type {"seconds_a_box" | "actions_a_box"} */ key, /** @type {string} */ color) {
  return (/** @type {Api.ReportedStatistics} */ { effort }, /** @type {Colors} */ colors) => {
    const entries = Object.entries(effort.by_origin).filter(([, entry]) => entry.boxes > 0);
    const names = entries.map(([name]) => originName(name).replace(" ", "<br>"));
    const y = entries.map(([, entry]) => entry[key]);
    return {
      traces: [{ type: "bar", x: names, y, marker: { color: colors[color] } }],
      layout: { yaxis: { rangemode: "tozero" }, margin: { l: 34, r: 6, t: 10, b: 40 } },
    };
  };
}

function stateChart(/** @type {Api.ReportedStatistics} */ { labels }, /** @type {Colors} */ colors) {
  const yaxis = { title: { text: "boxes" } };
  const classes = labels.by_class_and_state ?? null;
  if (classes) {
    const x = Object.keys(classes);
    const traces = STATES.map((state) => {
      const y = x.map((name) => classes[name][state] ?? 0);
      return { type: "bar", name: state, x, y, marker: { color: colors[state] } };
    });
    return { traces, layout: { barmode: "stack", yaxis } };
  }
  const y = STATES.map((state) => labels.by_state[state] ?? 0);
  return {
    traces: [{ type: "bar", x: STATES, y, marker: { color: STATES.map((state) => colors[state]) } }],
    layout: { yaxis },
  };
}
