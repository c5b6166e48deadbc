/** What the server counts, as tables and charts. Pure functions. */

import { duration, line, number, percent, plain, table } from "../charts.js";
import { colorIn, STATES } from "../colors.js";
import { count } from "../dom.js";

/** Classes with a line of their own in the chart of distances, those with most boxes. */
const MOST_CLASSES = 6;
/** Values of an attribute that are listed, and characters of a value that are shown. */
const [MOST_VALUES, MOST_CHARACTERS] = [12, 40];
/** Listed even without boxes: these compare proposals with drawing from scratch. */
const ALWAYS = ["proposal accepted untouched", "proposal edited", "from nothing"];
const DAY_MS = 86_400_000;
const FROM_ZERO = { rangemode: "tozero" };
const OVER_BOXES = {
  xaxis: { title: { text: "boxes labelled", font: { size: 12 } }, ...FROM_ZERO },
  margin: { l: 34, r: 6, t: 24, b: 40 },
};

const whole = (/** @type {number | null | undefined} */ value) => number(value, 0);

/** Bars of parts on top of each other, which have a colour and the properties of their traces. */
const bars = (
  /** @type {{ color: string, x: string[], y: number[] }[]} */ parts,
  /** @type {object} */ layout = {},
) => ({
  traces: parts.map(({ color, ...trace }) => ({ type: "bar", marker: { color }, ...trace })),
  layout: { barmode: "stack", yaxis: FROM_ZERO, showlegend: true, ...layout },
});

// -- the effort, by the origin of boxes

const originName = (/** @type {string} */ name) => `${name[0].toUpperCase()}${name.slice(1)}`;

export function effortTable(/** @type {Api.ReportedStatistics} */ { effort }) {
  const shown = Object.entries(effort.by_origin).filter(([name, entry]) => entry.boxes > 0 || ALWAYS.includes(name));
  const rows = [...shown, /** @type {const} */ (["all", effort])].map(([name, entry]) => [
    originName(name),
    whole(entry.boxes),
    number(entry.seconds_a_box),
    number(entry.actions_a_box),
  ]);
  return table("Effort per box", "stats-effort", ["Origin", "Boxes", "Seconds per box", "Actions per box"], rows);
}

// -- boxes by class and state

export function stateTable(/** @type {Api.ReportedStatistics} */ { labels }) {
  const cells = (/** @type {Record<string, number>} */ states) => {
    const counts = STATES.map((state) => states[state] ?? 0);
    return [...counts, counts.reduce((sum, value) => sum + value, 0)].map(whole);
  };
  const rows = Object.entries(labels.by_class_and_state).map(([name, states]) => [name, ...cells(states)]);
  rows.push(["All", ...cells(labels.by_state)]);
  return table("Boxes by class and state", "stats-states", ["Class", ...STATES, "All"], rows);
}

// -- values of attributes, and what else is counted

export function valueTables(/** @type {Api.ReportedStatistics} */ { attributes, without_value }) {
  const rows = Object.entries(attributes).map(([name, values]) => [
    name,
    valueList(values),
    whole(without_value[name] ?? 0),
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
  const texts = entries.slice(0, MOST_VALUES).map(([value, times]) => `${shortened(value)}: ${whole(times)}`);
  if (entries.length > MOST_VALUES) texts.push(count(entries.length - MOST_VALUES, "other value"));
  return texts.join(", ") || "none";
}

export function projectTable(/** @type {Api.ReportedStatistics} */ known) {
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
  ];
  for (const [detector, { as_suggested, corrected }] of Object.entries(known.suggested)) {
    rows.push([`Boxes accepted as suggested by ${detector}`, as_suggested]);
    rows.push([`Boxes suggested by ${detector} and corrected`, corrected]);
  }
  const counted = rows.map(([name, value]) => [name, whole(value)]);
  const detector = ["View detector in use", known.view_detector ?? "none"];
  return table("The project", "stats-project", ["What", "Number"], [...counted, detector]);
}

// -- people and days

const peopleOf = (/** @type {Api.Progress} */ { days }) => [...new Set(days.map(({ person }) => person))].sort();

const total = (
  /** @type {Api.WorkOfDay[]} */ entries,
  /** @type {"boxes" | "rejected" | "hours" | "actions"} */ key,
) => entries.reduce((sum, entry) => sum + entry[key], 0);

export function peopleTable(/** @type {Api.Progress} */ progress) {
  const cells = (/** @type {Api.WorkOfDay[]} */ entries) => {
    const [boxes, hours] = [total(entries, "boxes"), total(entries, "hours")];
    const days = new Set(entries.map(({ day }) => day)).size;
    const rate = hours > 0 ? whole(boxes / hours) : "–";
    const [rejected, actions] = [total(entries, "rejected"), total(entries, "actions")];
    return [whole(days), whole(boxes), whole(rejected), duration(hours), rate, whole(actions)];
  };
  const of = (/** @type {string} */ person) => progress.days.filter((entry) => entry.person === person);
  const rows = peopleOf(progress).map((person) => [person, ...cells(of(person))]);
  if (rows.length > 1) rows.push(["All", ...cells(progress.days)]);
  const heads = ["Person", "Days", "Boxes", "Rejected", "Time at work", "Boxes per hour", "Actions"];
  return table("People", "stats-people", heads, rows);
}

/** @param {string} day as 2026-01-05 */
const dayName = (day) =>
  new Date(`${day}T12:00`).toLocaleDateString("en", { weekday: "short", day: "numeric", month: "short" });

/** A row for each day, the newest first. */
export function dayTable(/** @type {Api.Progress} */ progress) {
  const people = peopleOf(progress);
  const cell = (/** @type {Api.WorkOfDay[]} */ entries) =>
    entries.length ? `${whole(total(entries, "boxes"))} in ${duration(total(entries, "hours"))}` : "–";
  const days = [...new Set(progress.days.map(({ day }) => day))].reverse();
  const rows = days.map((day) => {
    const entries = progress.days.filter((entry) => entry.day === day);
    const each = people.map((person) => entries.filter((entry) => entry.person === person));
    return [dayName(day), ...[...each, entries].map(cell)];
  });
  return table("Boxes and time per day", "stats-days", ["Day", ...people, "All"], rows);
}

export function dayChart(/** @type {Api.Progress} */ progress) {
  const { days: entries } = progress;
  const people = peopleOf(progress);
  const times = entries.map(({ day }) => Date.parse(day));
  // a tick for each day while they are few: a library that divides a day itself writes it several times
  const ticks = Math.max(...times) - Math.min(...times) < 10 * DAY_MS ? { dtick: DAY_MS } : {};
  const parts = people.map((person) => {
    const days = entries.filter((entry) => entry.person === person);
    return {
      name: plain(person),
      x: days.map(({ day }) => day),
      y: days.map(({ boxes }) => boxes),
      customdata: days.map(({ hours }) => duration(hours)),
      hovertemplate: "%{y} boxes in %{customdata}",
      color: colorIn(people, person),
    };
  });
  return bars(parts, { xaxis: { type: "date", tickformat: "%e %b", ...ticks } });
}

// -- the pace, as work went on

export function paceChart(/** @type {"seconds_a_box" | "actions_a_box"} */ key, /** @type {string} */ color) {
  return (/** @type {Api.Progress} */ { pace }, /** @type {Colors} */ colors) => ({
    traces: [course(pace.groups, (group) => group[key], "", colors[color], ".1f")],
    layout: { yaxis: FROM_ZERO, ...OVER_BOXES },
  });
}

export function trendChart(/** @type {Api.Progress} */ { pace }, /** @type {Colors} */ colors) {
  return {
    traces: [
      course(pace.groups, (group) => group.iou_proposal_to_final, "IoU with the final box", colors.accent, ".2f"),
      course(pace.groups, (group) => group.untouched, "accepted untouched", colors.good, ".0%"),
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
function course(groups, value, name, color, format) {
  let boxes = 0;
  return line(color, {
    x: groups.map((group) => (boxes += group.boxes)),
    y: groups.map(value),
    text: groups.map(({ first, last }) => [...new Set([first, last].map((time) => time.slice(0, 10)))].join(" to ")),
    hovertemplate: `%{y:${format}} until box %{x}, %{text}<extra>${name}</extra>`,
    name,
  });
}

// -- what became of proposals

/** @type {["untouched" | "corrected" | "rejected" | "missed", string][]} */
const FATES = [
  ["untouched", "accepted"],
  ["corrected", "edited"],
  ["rejected", "rejected"],
  ["missed", "muted"],
];

export function qualityTable(/** @type {Api.Progress} */ { proposals }) {
  const rows = Object.entries(proposals.by_class).map(([name, quality]) => {
    const { untouched, corrected, rejected, iou_proposal_to_final: iou } = quality;
    const share = untouched / (untouched + corrected + rejected);
    const counts = FATES.map(([fate]) => whole(quality[fate]));
    return [name, number(iou, 2), percent(Number.isNaN(share) ? null : share), ...counts];
  });
  const heads = ["Class", "IoU", "Accepted untouched", ...FATES.map(([fate]) => originName(fate))];
  return table("Proposals and what became of them", "stats-quality", heads, rows);
}

export function classChart(/** @type {Api.Progress} */ { proposals }, /** @type {Colors} */ colors) {
  const classes = Object.entries(proposals.by_class);
  const x = classes.map(([name]) => plain(name));
  return bars(FATES.map(([name, color]) => ({ name, x, y: classes.map(([, of]) => of[name]), color: colors[color] })));
}

const rangeName = (/** @type {Api.RangeQuality} */ { from_m, to_m }) =>
  to_m === null ? `over ${from_m} m` : `${from_m}–${to_m} m`;

export function rangeTable(/** @type {Api.Progress} */ { proposals }) {
  const ranges = proposals.by_range;
  const cells = (/** @type {Api.RangeQuality[]} */ entries) =>
    ranges.map(({ from_m }) => number(entries.find((entry) => entry.from_m === from_m)?.iou_proposal_to_final, 2));
  const rows = Object.entries(proposals.by_class_and_range).map(([name, entries]) => [name, ...cells(entries)]);
  if (rows.length > 1) rows.push(["All", ...cells(ranges)]);
  const heads = ["Class", ...ranges.map(rangeName)];
  return table("IoU of proposal and final box, by distance", "stats-ranges", heads, rows);
}

export function rangeChart(/** @type {Api.Progress} */ { proposals }) {
  const classes = Object.keys(proposals.by_class);
  const boxes = (/** @type {string} */ name) => FATES.reduce((sum, [fate]) => sum + proposals.by_class[name][fate], 0);
  const common = classes.toSorted((a, b) => boxes(b) - boxes(a));
  return {
    traces: common.slice(0, MOST_CLASSES).map((name) => {
      const ranges = proposals.by_class_and_range[name].filter((entry) => entry.iou_proposal_to_final !== null);
      return line(colorIn(classes, name), {
        x: ranges.map(rangeName),
        y: ranges.map((entry) => entry.iou_proposal_to_final),
        text: ranges.map((entry) => count(entry.untouched + entry.corrected, "proposal")),
        hovertemplate: "%{y:.2f}, %{text}",
        name: plain(name),
      });
    }),
    layout: {
      yaxis: { range: [0, 1.02] },
      xaxis: { categoryorder: "array", categoryarray: proposals.by_range.map(rangeName) },
      showlegend: true,
    },
  };
}
