/** The column on the left: the queue of proposals, and the boxes of the open frame. */

import { valuesText } from "../attributes.js";
import { boxAxis } from "../box3d.js";
import { button, count, h, iconButton, patch } from "../dom.js";
import { headingMark, jumpText } from "../heading_mark.js";
import { isOpen } from "./desk.js";
import { shortName } from "./drawing.js";
import { summary } from "./fields.js";
import { DRAGS, progressOf } from "./items.js";
import { REST_MS } from "./opening.js";
import { ORDERS, OWN } from "./queue.js";
import { makeHash } from "../router.js";
import { createValueFilter, refill } from "./value_filter.js";

/** Rows of the queue that are shown around the current one; others come and go in such numbers. */
const [ROWS, STEP] = [120, 60];

export function createQueueList(/** @type {Annotate} */ at) {
  const { app, queue, opening } = at;
  const go = (/** @type {Target} */ target) => opening.go(target, true);
  /** A choice of the queue. @returns {HTMLSelectElement} */
  const select = (
    /** @type {"order" | "label" | "source"} */ key,
    /** @type {string} */ name,
    /** @type {string} */ id,
  ) =>
    h("select", {
      "aria-label": name,
      "data-testid": `queue-${id}`,
      onchange(event) {
        const field = /** @type {HTMLSelectElement} */ (event.currentTarget);
        // so that Space and the digits are keys of the mode again
        field.blur();
        choose({ [key]: field.value });
      },
    });
  const order = select("order", "Order of the queue", "order");
  const label = select("label", "Class in the queue", "class");
  const source = select("source", "Source in the queue", "source");
  const values = createValueFilter(app, (value) => choose({ value }));
  const left = h("span.number.muted", { "data-testid": "queue-remaining" });
  const list = h("ol.rows", { "data-testid": "queue" });
  /** @type {string | null} */
  let current = null;
  /**
   * The rows as they stand: what is reviewed keeps its place and what is new comes last, so that nothing moves.
   *
   * @type {QueueItem[]}
   */
  let standing = [];
  let answered = 0;
  fill();
  order.append(...ORDERS.map(([value, text]) => h("option", { value }, text)));
  order.value = queue.order;
  at.parts.queue.replaceChildren(
    h("header", h("h2", "To review"), h("span.grow"), left),
    h("div.choices", order, label, source, values.root),
    list,
  );

  /** Fills in the classes and values of the project. A filter by one that is gone ends. */
  function fill() {
    const { classes } = app.state.project;
    label.hidden = classes.length < 2;
    const isEnded = [refill(label, "All classes", new Map(classes.map((name) => [name, name]))), values.fill()].some(
      Boolean,
    );
    if (isEnded) choose({ label: label.value, value: values.query() });
  }

  async function choose(/** @type {Parameters<Queue["choose"]>[0]} */ changes) {
    await queue.choose(changes);
    if (queue.items[0]) await go(queue.items[0]);
  }

  /** Offers the sources of the proposals, once there are any but annotator itself. */
  function showSources() {
    const names = new Set([...Object.keys(queue.sources), ...(source.value ? [source.value] : [])]);
    const textOf = (/** @type {string} */ name) => `${name} (${queue.sources[name] ?? 0})`;
    refill(source, "All sources", new Map([...names].map((name) => [name, textOf(name)])));
    source.hidden = [...names].every((name) => name === OWN);
  }

  /** Shown in place of the items if there are none. */
  function nothing() {
    // the project may be left already
    const name = app.state.route.project;
    if (!queue.isFiltered)
      return [
        h(
          "p",
          { "data-testid": "review-done" },
          "Nothing is left to review. Draw a box on the image, ",
          h("a", { href: makeHash(name, "train") }, "propose more"),
          ", or ",
          h("a", { href: makeHash(name, "export") }, "export"),
          ".",
        ),
      ];
    const clear = () => {
      label.value = source.value = "";
      values.clear();
      choose({ label: "", value: {}, source: "" });
    };
    return [h("p", "No proposal matches the filter."), button("Show all", clear, { "data-testid": "queue-clear" })];
  }

  function queueRow(/** @type {QueueItem} */ item, /** @type {boolean} */ isCurrent, /** @type {boolean} */ isDone) {
    const isOurs = item.sources.every((name) => name === OWN);
    const recording = app.state.project?.recordings.find(({ id }) => id === item.recording)?.name ?? "";
    const place = `${recording}, frame ${item.number}`;
    // as the list of the open frame has it; up is not known of other frames
    const box = app.state.frame?.labels.find(({ uid }) => uid === item.uid)?.box;
    const heading = box ? boxAxis(box, 0) : item.heading;
    const title = [
      `${isDone ? "reviewed: " : ""}${item.label ?? "Nothing is drawn yet"}, ${place} (${item.key})`,
      isOurs ? "" : `, seen by ${item.sources.join(", ")}`,
    ].join("");
    const content = [
      h("span.ellipsis.grow", item.label ?? "draw"),
      isOurs ? null : saidBy(item.sources),
      heading && headingMark(heading, box ? (app.state.frame?.up ?? null) : null),
      doubtBar(item.doubt),
      h("span.muted.place", place),
    ];
    const row = button(content, () => go(item), {
      class: isDone ? "quiet row-button done" : "quiet row-button",
      "aria-current": isCurrent ? "true" : null,
      title,
      "data-testid": isDone ? "queue-done" : "queue-item",
      "data-uid": item.uid,
    });
    return h("li", { "data-key": keyOf(item) }, row);
  }

  return {
    fill,
    show(/** @type {string | null} */ uid) {
      showSources();
      left.textContent = count(queue.remaining, queue.order === "teach" ? "frame" : "proposal");
      const frame = app.state.frame?.frame.id;
      const isShown = (/** @type {QueueItem} */ item) => (item.uid === null ? item.frame === frame : item.uid === uid);
      const open = new Map(queue.items.map((item) => [keyOf(item), item]));
      if (answered !== queue.answered) standing = [];
      answered = queue.answered;
      const known = new Set(standing.map(keyOf));
      const fresh = queue.items.filter((item) => !known.has(keyOf(item)));
      const isGoingOn = standing.some((item) => open.has(keyOf(item)));
      standing = isGoingOn ? [...standing.map((item) => open.get(keyOf(item)) ?? item), ...fresh] : queue.items;
      const at = standing.findIndex(isShown);
      const from = Math.max(0, STEP * Math.floor((at - STEP / 2) / STEP));
      const rows = standing
        .slice(from, from + ROWS)
        .map((item) => queueRow(item, isShown(item), !open.has(keyOf(item))));
      patch(list, rows.length > 0 ? rows : h("li.muted.pad", ...nothing()));
      // not again, so that an operator who looks elsewhere in the list is left there
      if (uid !== current) list.querySelector("[aria-current]")?.scrollIntoView({ block: "nearest" });
      current = uid;
    },
  };
}

const keyOf = (/** @type {QueueItem} */ item) => item.uid ?? `frame ${item.frame}`;

/** Such as "mine +1". */
function saidBy(/** @type {string[]} */ [first, ...others]) {
  return h(
    "span.said.muted",
    { "data-testid": "queue-said" },
    h("span.ellipsis", first),
    others.length ? h("span", ` +${others.length}`) : null,
  );
}

function doubtBar(/** @type {number | null} */ doubt) {
  if (doubt === null || doubt === undefined) return h("span.doubt");
  const bar = h("i");
  bar.style.width = `${Math.round(100 * doubt)}%`;
  return h("span.doubt", { title: `Doubt ${Math.round(100 * doubt)} %` }, bar);
}

/**
 * The boxes of the frame; if several are open, with a small picture of each, so that they can be accepted together.
 */
export function createBoxList(/** @type {Annotate} */ at) {
  const { app, desk } = at;
  const title = h("h2", "In this frame");
  const note = h("p.muted.pad.ellipsis", { "data-testid": "frame-summary" });
  const list = h("ul.rows", { "data-testid": "frame-boxes" });
  /** @type {Map<string, string>} */
  let pictures = new Map();
  let known = "";
  /** The frame whose rows have pictures. @type {number | null} */
  let pictured = null;
  let request = new AbortController();
  at.parts.boxes.replaceChildren(h("header", title), note, list);

  at.until.addEventListener("abort", () => request.abort());

  function draw() {
    const labels = desk.labels();
    // once there, their places stay until another frame is shown
    const frame = app.state.frame?.frame.id ?? null;
    if (labels.filter((label) => isPictured(label) && isOpen(label) && !label.isNew).length > 1) pictured = frame;
    patch(
      list,
      labels.map((label) => boxRow(label, pictured === frame && isPictured(label))),
      at.teach.unfinished.map(unfinishedRow),
    );
  }

  function boxRow(/** @type {PageLabel} */ label, /** @type {boolean} */ hasPicture) {
    const { uid, better_in } = label;
    const problem = desk.problemOf(uid);
    const { box } = desk.seen(label);
    const state = problem ? "not saved" : label.isNew ? "new" : label.state;
    const src = pictures.get(uid);
    const content = [
      h("span", { class: `dot state-${label.state}`, "aria-hidden": "true" }),
      h("span", { class: `${better_in === null ? "" : "muted "}ellipsis grow` }, shortName(label, desk.labels())),
      headingMark(boxAxis(box, 0), app.state.frame?.up ?? null, jumpText({ ...label, box })),
      h("span", { class: problem ? "bad" : `state-${label.state}` }, state),
      // its place is there before it is drawn
      hasPicture && (src ? h("img.small-views", { src, alt: "" }) : h("span.small-views")),
    ];
    const elsewhere = better_in === null ? "" : "another camera sees it better: a double click goes there";
    const row = button(content, () => desk.select(uid), {
      class: "quiet row-button",
      "aria-current": uid === desk.uid ? "true" : null,
      title: problem ? `Not saved. ${problem}` : [valuesText(app, label), elsewhere].filter(Boolean).join(" · "),
      "data-testid": "frame-box",
      "data-uid": uid,
      "data-state": label.state,
      ondblclick: () => at.showBest(uid),
    });
    return h("li", { "data-key": uid }, row);
  }

  /** An object that is being drawn: it has no 3D box yet. */
  function unfinishedRow(/** @type {Item} */ item) {
    const { label } = item.image_box;
    const done = progressOf(item);
    const dots = Array.from({ length: DRAGS }, (_, i) => h("i", { class: i < done ? "on" : "" }));
    const content = [
      h("span.ellipsis.grow", label),
      h("span.dots", { "aria-hidden": "true" }, dots),
      h("span.muted", `${done} of ${DRAGS} boxes`),
    ];
    const row = button(content, () => at.teach.open(item), {
      class: "quiet row-button",
      title: "Continue on its pseudo-views",
      "aria-current": item === at.teach.draft?.item ? "true" : null,
    });
    const remove = iconButton("trash", `Delete this ${label}`, () => at.teach.remove(item));
    return h("li.row.unfinished", { "data-testid": "object", "data-boxes": done }, row, remove);
  }

  /** Reads the pictures of the frame as it is now. */
  async function readPictures() {
    const frame = app.state.frame?.frame;
    const key = frame ? `${frame.id}/${frame.revision}` : "";
    if (!frame || key === known || desk.labels().filter(isPictured).filter(isOpen).length < 2) return;
    request.abort();
    request = new AbortController();
    if (known.split("/")[0] !== String(frame.id)) pictures = new Map();
    known = key;
    const { signal } = request;
    const take = (/** @type {Api.TileJson} */ { uid, png }) =>
      png && pictures.set(uid, `data:image/png;base64,${png}`);
    await new Promise((resolve) => setTimeout(resolve, REST_MS));
    if (signal.aborted) return;
    await app.api.lines(app.path("frames", frame.id, "sheet"), take, { signal });
    if (!signal.aborted) draw();
  }

  return {
    show() {
      note.textContent = note.title = summary(desk.labels());
      draw();
      void readPictures();
    },
  };
}

/** Boxes that another camera of the rig sees better are reviewed there. */
const isPictured = (/** @type {PageLabel} */ { better_in }) => better_in === null;
