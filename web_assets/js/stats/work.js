/** The work on a project: who labelled how much, whether it gets faster, and where proposals are good. */

import { createCharts, duration, number, percent, plain, table } from "../charts.js";
import { colorIn } from "../colors.js";
import { count, h } from "../dom.js";

/** Classes with a line of their own in the chart of distances, those with most boxes. */
const MOST_CLASSES = 6;

export function createWork() {
  const charts = createCharts("div.charts.three", [
    ["Boxes labelled per day", "work-days", dayChart],
    ["Seconds per box, as work went on", "work-seconds", paceChart("seconds_a_box", "accent")],
    ["Actions per box, as work went on", "work-actions", paceChart("actions_a_box", "proposed")],
    ["Proposals, as work went on", "work-proposals", trendChart],
    ["IoU of proposal and final box, by distance", "work-ranges", rangeChart],
    ["What became of proposals, by class", "work-classes", classChart],
  ]);
  const element = h("section.panel", { hidden: true }, h("div.body", charts.root));

  return {
    element,
    show(/** @type {Api.Progress} */ progress) {
      element.hidden = progress.days.length === 0;
      if (!element.hidden) void charts.draw(progress);
    },
    destroy: charts.destroy,
  };
}

const peopleOf = (/** @type {Api.Progress} */ { days }) => [...new Set(days.map(({ person }) => person))].sort();

/** @param {string} day as 2026-01-05 */
const dayName = (day) =>
  new Date(`${day}T12:00`).toLocaleDateString("en", { weekday: "short", day: "numeric", month: "short" });

function dayChart(/** @type {Api.Progress} */ progress) {
  const people = peopleOf(progress);
  return {
    traces: people.map((person) => {
      const days = progress.days.filter((entry) => entry.person === person);
      return {
        type: "bar",
        name: plain(person),
        x: days.map(({ day }) => day),
        y: days.map(({ boxes }) => boxes),
        customdata: days.map(({ hours }) => duration(hours)),
        hovertemplate: "%{y} boxes in %{customdata}",
        marker: { color: colorIn(people, person) },
      };
    }),
    layout: { barmode: "stack", xaxis: { type: "date", tickformat: "%e %b", ...everyDay(progress) }, ...forBoxes },
  };
}

const DAY_MS = 86_400_000;

/** A tick for each day while they are few: a library that divides a day itself writes it several times. */
function everyDay(/** @type {Api.Progress} */ { days }) {
  const times = days.map(({ day }) => Date.parse(day));
  return Math.max(...times) - Math.min(...times) < 10 * DAY_MS ? { dtick: DAY_MS } : {};
}

const forBoxes = { yaxis: { rangemode: "tozero" }, showlegend: true };

function paceChart(/** @type {"seconds_a_box" | "actions_a_box"} */ key, /** @type {string} */ color) {
  return (/** @type {Api.Progress} */ { pace }, /** @type {Colors} */ colors) => ({
    traces: [line(pace.groups, (group) => group[key], "", colors[color], ".1f")],
    layout: { yaxis: { rangemode: "tozero" }, ...OVER_BOXES },
  });
}

const OVER_BOXES = {
  xaxis: { title: { text: "boxes labelled", font: { size: 12 } }, rangemode: "tozero" },
  margin: { l: 34, r: 6, t: 24, b: 40 },
};

function trendChart(/** @type {Api.Progress} */ { pace }, /** @type {Colors} */ colors) {
  return {
    traces: [
      line(pace.groups, (group) => group.iou_proposal_to_final, "IoU with the final box", colors.accent, ".2f"),
      line(pace.groups, (group) => group.untouched, "accepted untouched", colors.good, ".0%"),
    ],
    layout: { yaxis: { range: [0, 1.02] }, ...OVER_BOXES },
  };
}

/**
 * @param {Api.PaceGroup[]} groups
 * @param {(group: Api.PaceGroup) => number | null} value
 * @param {string} name
 * @param {string} color
 * @param {string} format of d3
 */
function line(groups, value, name, color, format) {
  let boxes = 0;
  return {
    x: groups.map((group) => (boxes += group.boxes)),
    y: groups.map(value),
    text: groups.map(({ first, last }) => [...new Set([first, last].map((time) => time.slice(0, 10)))].join(" to ")),
    hovertemplate: `%{y:${format}} until box %{x}, %{text}<extra>${name}</extra>`,
    name,
    mode: "lines+markers",
    line: { color, width: 1.6 },
    marker: { size: 4 },
  };
}

const rangeName = (/** @type {Api.RangeQuality} */ { from_m, to_m }) =>
  to_m === null ? `over ${from_m} m` : `${from_m}–${to_m} m`;

const countOf = (/** @type {Api.Quality} */ { untouched, corrected, rejected, missed }) =>
  untouched + corrected + rejected + missed;

function rangeChart(/** @type {Api.Progress} */ { proposals }) {
  const classes = Object.keys(proposals.by_class);
  const common = [...classes].sort((a, b) => countOf(proposals.by_class[b]) - countOf(proposals.by_class[a]));
  return {
    traces: common.slice(0, MOST_CLASSES).map((name) => {
      const ranges = proposals.by_class_and_range[name].filter((entry) => entry.iou_proposal_to_final !== null);
      return {
        x: ranges.map(rangeName),
        y: ranges.map((entry) => entry.iou_proposal_to_final),
        text: ranges.map((entry) => count(entry.untouched + entry.corrected, "proposal")),
        hovertemplate: "%{y:.2f}, %{text}",
        name: plain(name),
        mode: "lines+markers",
        line: { color: colorIn(classes, name), width: 1.6 },
        marker: { size: 5 },
      };
    }),
    layout: {
      yaxis: { range: [0, 1.02] },
      xaxis: { categoryorder: "array", categoryarray: proposals.by_range.map(rangeName) },
      showlegend: true,
    },
  };
}

function classChart(/** @type {Api.Progress} */ { proposals }, /** @type {Colors} */ colors) {
  const names = Object.keys(proposals.by_class);
  /** @type {["untouched" | "corrected" | "rejected" | "missed", string][]} */
  const parts = [
    ["untouched", colors.accepted],
    ["corrected", colors.edited],
    ["rejected", colors.rejected],
    ["missed", colors.muted],
  ];
  return {
    traces: parts.map(([part, color]) => ({
      type: "bar",
      name: part,
      x: names.map(plain),
      y: names.map((name) => proposals.by_class[name][part]),
      marker: { color },
    })),
    layout: { barmode: "stack", ...forBoxes },
  };
}

export function peopleTable(/** @type {Api.Progress} */ progress) {
  const rows = peopleOf(progress).map((person) => [
    person,
    ...workCells(progress.days.filter((entry) => entry.person === person)),
  ]);
  if (rows.length > 1) rows.push(["All", ...workCells(progress.days)]);
  const heads = ["Person", "Days", "Boxes", "Rejected", "Time at work", "Boxes per hour", "Actions"];
  return table("People", "stats-people", heads, rows);
}

function workCells(/** @type {Api.WorkOfDay[]} */ entries) {
  const [boxes, hours] = [total(entries, "boxes"), total(entries, "hours")];
  return [
    number(new Set(entries.map(({ day }) => day)).size, 0),
    number(boxes, 0),
    number(total(entries, "rejected"), 0),
    duration(hours),
    hours > 0 ? number(boxes / hours, 0) : "–",
    number(total(entries, "actions"), 0),
  ];
}

const total = (
  /** @type {Api.WorkOfDay[]} */ entries,
  /** @type {"boxes" | "rejected" | "hours" | "actions"} */ key,
) => entries.reduce((sum, entry) => sum + entry[key], 0);

/** A row for each day, the newest first. */
export function dayTable(/** @type {Api.Progress} */ progress) {
  const people = peopleOf(progress);
  const days = [...new Set(progress.days.map(({ day }) => day))].reverse();
  const rows = days.map((day) => {
    const entries = progress.days.filter((entry) => entry.day === day);
    const each = people.map((person) => entries.filter((entry) => entry.person === person));
    return [dayName(day), ...[...each, entries].map(boxesAndTime)];
  });
  return table("Boxes and time per day", "stats-days", ["Day", ...people, "All"], rows);
}

const boxesAndTime = (/** @type {Api.WorkOfDay[]} */ entries) =>
  entries.length ? `${number(total(entries, "boxes"), 0)} in ${duration(total(entries, "hours"))}` : "–";

export function qualityTable(/** @type {Api.Progress} */ { proposals }) {
  const rows = Object.entries(proposals.by_class).map(([name, quality]) => {
    const { untouched, corrected, rejected, missed } = quality;
    const share = untouched / (untouched + corrected + rejected);
    const counts = [untouched, corrected, rejected, missed].map((count) => number(count, 0));
    return [name, number(quality.iou_proposal_to_final, 2), percent(Number.isNaN(share) ? null : share), ...counts];
  });
  const heads = ["Class", "IoU", "Accepted untouched", "Untouched", "Corrected", "Rejected", "Missed"];
  return table("Proposals and what became of them", "stats-quality", heads, rows);
}

export function rangeTable(/** @type {Api.Progress} */ { proposals }) {
  const ranges = proposals.by_range;
  const cells = (/** @type {Api.RangeQuality[]} */ entries) =>
    ranges.map(({ from_m }) => number(entries.find((entry) => entry.from_m === from_m)?.iou_proposal_to_final, 2));
  const rows = Object.entries(proposals.by_class_and_range).map(([name, entries]) => [name, ...cells(entries)]);
  if (rows.length > 1) rows.push(["All", ...cells(ranges)]);
  const heads = ["Class", ...ranges.map(rangeName)];
  return table("IoU of proposal and final box, by distance", "stats-ranges", heads, rows);
}
