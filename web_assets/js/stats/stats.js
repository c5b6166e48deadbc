/**
 * Statistics: the effort of a box, the quality of proposals, and the project's progress, as in `annotator stats
 * --json`.
 */

import { createChart, duration, number, percent, section, table } from "../charts.js";
import { count, h, patch } from "../dom.js";
import { messageOf } from "../errors.js";
import { makeHash } from "../router.js";
import { createWork, dayTable, peopleTable, qualityTable, rangeTable } from "./work.js";

/** How long to rest between two readings, relative to the time that one takes. */
const REST = 20;
/** Values of an attribute that are listed. */
const MOST_VALUES = 12;
/** Characters of a value that are shown. */
const MOST_CHARACTERS = 40;
const STATES = ["proposed", "accepted", "edited", "rejected"];
/** @type {Record<string, string>} */
const ORIGINS = {
  "proposal accepted untouched": "Proposal, accepted untouched",
  "proposal edited": "Proposal, edited",
  "from nothing": "From scratch",
  "placed in 3D": "Placed in 3D",
  copied: "Copied",
  "import edited": "Imported, edited",
};
/** Listed even without boxes: these compare proposals with drawing from scratch. */
const ALWAYS = ["proposal accepted untouched", "proposal edited", "from nothing"];

export function mount(/** @type {HTMLElement} */ root, /** @type {ModeApp} */ app) {
  const tiles = h("div", { class: "tiles", "data-testid": "stats-tiles" });
  const secondsHost = h("div", { class: "chart" });
  const actionsHost = h("div", { class: "chart" });
  const stateHost = h("div", { class: "chart" });
  const tables = h("div", { class: "stack" });
  const chartsBox = h(
    "div",
    { class: "charts three" },
    h("figure", {}, h("figcaption", {}, "Seconds per box, by origin"), secondsHost),
    h("figure", {}, h("figcaption", {}, "Actions per box"), actionsHost),
    h("figure", {}, h("figcaption", {}, "Boxes by class and state"), stateHost),
  );
  const chartsPanel = h("section", { class: "panel" }, h("div", { class: "body" }, chartsBox));
  const work = createWork();
  root.append(
    h(
      "div",
      { class: "page wide", "data-testid": "statistics" },
      h("h1", {}, "Statistics"),
      tiles,
      work.element,
      chartsPanel,
      tables,
    ),
  );
  /** @type {Api.ReportedStatistics | null} */
  let known = null;
  let ended = false;
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  let timer;
  let restsUntilMs = 0;
  const charts = [
    createChart(secondsHost, (colors) => effortChart(known, "seconds_a_box", colors.accent)),
    createChart(actionsHost, (colors) => effortChart(known, "actions_a_box", colors.proposed)),
    createChart(stateHost, (colors) => stateChart(known, colors)),
  ];

  async function load() {
    timer = undefined;
    const beganMs = performance.now();
    /** @type {Api.ReportedStatistics} */
    let fresh;
    try {
      fresh = await app.api.get(app.path("statistics"));
    } catch (error) {
      if (!ended) patch(tiles, h("p", { class: "error-box", role: "alert" }, messageOf(error)));
      return;
    } finally {
      restsUntilMs = performance.now() + REST * (performance.now() - beganMs);
    }
    if (ended) return;
    known = fresh;
    const isEmpty = fresh.labels.total === 0;
    patch(tiles, tilesOf(fresh));
    patch(tables, isEmpty ? nothingYet(app) : tablesOf(fresh));
    chartsPanel.hidden = isEmpty;
    work.show(fresh.progress);
    for (const chart of charts) void chart.draw();
  }

  /** Reads the numbers again, not more often than the server can well compute them. */
  function loadSoon() {
    timer ??= setTimeout(load, Math.max(0, restsUntilMs - performance.now()));
  }

  const stop = [app.events.on("frame", loadSoon), app.events.on("reconnected", loadSoon)];
  void load();
  return {
    unmount() {
      ended = true;
      clearTimeout(timer);
      work.destroy();
      for (const end of stop) end();
      for (const chart of charts) chart.destroy();
    },
  };
}

const originName = (/** @type {string} */ name) => ORIGINS[name] ?? name;

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
    ["IoU of proposal and final box", number(iou_proposal_to_final, 2), "mean 3D overlap; 1 = same box"],
    ["Work left", duration(hours_left?.expected), left],
  ].map(([name, value, help]) =>
    h(
      "div",
      { class: "tile" },
      h("div", { class: "tile-name" }, name),
      h("div", { class: "tile-value number" }, value),
      h("div", { class: "muted" }, help),
    ),
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
  return section(
    "Effort per box",
    table(["Origin", "Boxes", "Seconds per box", "Actions per box"], rows, "stats-effort"),
  );
}

function countTable(/** @type {Api.ReportedStatistics} */ { labels }) {
  const classes = labels.by_class_and_state ?? null;
  if (!classes) {
    const rows = [
      ...STATES.map((state) => [state, number(labels.by_state[state] ?? 0, 0)]),
      ["All", number(labels.total, 0)],
    ];
    return section("Boxes by state", table(["State", "Boxes"], rows, "stats-states"));
  }
  const rows = Object.entries(classes).map(([name, states]) => [
    name,
    ...STATES.map((state) => number(states[state] ?? 0, 0)),
    number(sum(Object.values(states)), 0),
  ]);
  rows.push(["All", ...STATES.map((state) => number(labels.by_state[state] ?? 0, 0)), number(labels.total, 0)]);
  return section("Boxes by class and state", table(["Class", ...STATES, "All"], rows, "stats-states"));
}

function valueTable(/** @type {Api.ReportedStatistics} */ { attributes, without_value }) {
  const rows = Object.entries(attributes).map(([name, values]) => [
    name,
    valueList(values),
    number(without_value[name] ?? 0, 0),
  ]);
  const heads = ["Attribute", "Values", "Without a value"];
  return rows.length ? [section("Values of attributes", table(heads, rows, "stats-attributes"))] : [];
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
    ...suggestedRows(known),
  ];
  const counted = rows.map(([name, value]) => [name, number(value, 0)]);
  return section(
    "The project",
    table(["What", "Number"], [...counted, ["View detector in use", known.view_detector ?? "none"]], "stats-project"),
  );
}

/** @returns {[string, number][]} */
function suggestedRows(/** @type {Api.ReportedStatistics} */ { suggested }) {
  return Object.entries(suggested).flatMap(([detector, { as_suggested, corrected }]) => [
    [`Boxes accepted as suggested by ${detector}`, as_suggested],
    [`Boxes suggested by ${detector} and corrected`, corrected],
  ]);
}

function effortChart(
  /** @type {Api.ReportedStatistics | null} */ known,
  /** @type {"seconds_a_box" | "actions_a_box"} */ key,
  /** @type {string} */ color,
) {
  const entries = Object.entries(known?.effort.by_origin ?? {}).filter(([, entry]) => entry.boxes > 0);
  const names = entries.map(([name]) => originName(name).replace(", ", ",<br>"));
  return {
    traces: [{ type: "bar", x: names, y: entries.map(([, entry]) => entry[key]), marker: { color } }],
    layout: { yaxis: { rangemode: "tozero" }, margin: { l: 34, r: 6, t: 10, b: 40 } },
  };
}

function stateChart(/** @type {Api.ReportedStatistics | null} */ known, /** @type {Record<string, string>} */ colors) {
  const classes = known?.labels.by_class_and_state ?? null;
  if (classes) {
    const names = Object.keys(classes);
    return {
      traces: STATES.map((state) => ({
        type: "bar",
        name: state,
        x: names,
        y: names.map((name) => classes[name][state] ?? 0),
        marker: { color: colors[state] },
      })),
      layout: { barmode: "stack", yaxis: { title: { text: "boxes" } } },
    };
  }
  const states = known?.labels.by_state ?? {};
  return {
    traces: [
      {
        type: "bar",
        x: STATES,
        y: STATES.map((state) => states[state] ?? 0),
        marker: { color: STATES.map((state) => colors[state]) },
      },
    ],
    layout: { yaxis: { title: { text: "boxes" } } },
  };
}

const sum = (/** @type {number[]} */ values) => values.reduce((total, value) => total + value, 0);

function nothingYet(/** @type {ModeApp} */ app) {
  return h(
    "div",
    { class: "empty" },
    h("h2", {}, "No boxes yet"),
    h("p", {}, "The numbers are shown once objects are labelled or proposed."),
    h("a", { class: "button", href: makeHash(app.state.route.project, "annotate") }, "Annotate"),
  );
}
