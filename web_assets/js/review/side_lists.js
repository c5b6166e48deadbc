/** The column on the left: the queue of proposals, and the boxes of the open frame. */

import { count, h } from "../dom.js";
import { shortName } from "./drawing.js";
import { summary } from "./fields.js";
import { ORDERS } from "./queue.js";

/** Rows of the queue that are shown around the current one. */
const ROWS = 120;

/**
 * @param {HTMLElement} host
 * @param {ModeApp} app
 * @param {Queue} queue
 * @param {{ open: (target: Target) => unknown }} options
 */
export function createQueueList(host, app, queue, { open }) {
  /** @type {HTMLSelectElement} */
  const order = h(
    "select",
    {
      "aria-label": "Order of the queue",
      "data-testid": "queue-order",
      onchange: () => choose(order, { order: order.value }),
    },
    ORDERS.map(([value, text]) => h("option", { value }, text)),
  );
  /** @type {HTMLSelectElement} */
  const label = h(
    "select",
    {
      "aria-label": "Class in the queue",
      "data-testid": "queue-class",
      onchange: () => choose(label, { label: label.value }),
    },
    h("option", { value: "" }, "All classes"),
    app.state.project.classes.map((name) => h("option", { value: name }, name)),
  );
  const left = h("span", { class: "number muted", "data-testid": "queue-remaining" });
  const list = h("ol", { class: "rows", "data-testid": "queue" });
  label.hidden = app.state.project.classes.length < 2;
  order.value = queue.order;
  host.replaceChildren(
    h("header", {}, h("h2", {}, "To review"), h("span", { class: "grow" }), left),
    h("div", { class: "choices" }, order, label),
    list,
  );

  /**
   * @param {HTMLSelectElement} select
   * @param {{ order?: string, label?: string }} changes
   */
  function choose(select, changes) {
    // so that Space and the digits are keys of the mode again
    select.blur();
    queue.choose(changes).then(() => queue.items[0] && open(queue.items[0]), app.toast);
  }

  return {
    /** @param {string | null} uid */
    show(uid) {
      left.textContent = count(queue.remaining, "proposal");
      const at = Math.max(
        0,
        queue.items.findIndex((item) => item.uid === uid),
      );
      const from = Math.max(0, Math.min(at - ROWS / 2, queue.items.length - ROWS));
      const recordings = new Map((app.state.project?.recordings ?? []).map(({ id, name }) => [id, name]));
      list.replaceChildren(
        ...queue.items.slice(from, from + ROWS).map((item) => queueRow(item, recordings, item.uid === uid, open)),
      );
      if (queue.items.length === 0) list.append(h("li", { class: "muted pad" }, "No proposals left to review."));
      list.querySelector("[aria-current]")?.scrollIntoView({ block: "nearest" });
    },
  };
}

/**
 * @param {QueueItem} item
 * @param {Map<number, string>} recordings
 * @param {boolean} isCurrent
 * @param {(target: Target) => unknown} open
 */
function queueRow(item, recordings, isCurrent, open) {
  const place = `${recordings.size > 1 ? `${recordings.get(item.recording) ?? ""} ` : ""}${item.key}`;
  return h(
    "li",
    {},
    h(
      "button",
      {
        type: "button",
        class: "quiet row-button",
        "aria-current": isCurrent ? "true" : null,
        title: `${item.label}, frame ${place}`,
        onclick: () => open(item),
        "data-testid": "queue-item",
        "data-uid": item.uid,
      },
      h("span", { class: "ellipsis grow" }, item.label),
      h("span", { class: "muted ellipsis number" }, place),
      doubtBar(item.doubt),
    ),
  );
}

/** @param {number | null} doubt */
function doubtBar(doubt) {
  if (doubt === null || doubt === undefined) return h("span", { class: "doubt" });
  const bar = h("i", {});
  bar.style.width = `${Math.round(100 * doubt)}%`;
  return h("span", { class: "doubt", title: `Doubt ${Math.round(100 * doubt)} %` }, bar);
}

/**
 * @param {HTMLElement} host
 * @param {Desk} desk
 */
export function createBoxList(host, desk) {
  const title = h("h2", {}, "In this frame");
  const note = h("p", { class: "muted pad", "data-testid": "frame-summary" });
  const list = h("ul", { class: "rows", "data-testid": "frame-boxes" });
  host.replaceChildren(h("header", {}, title), note, list);
  return {
    show() {
      note.textContent = summary(desk.labels());
      list.replaceChildren(...desk.labels().map((label) => boxRow(label, desk)));
    },
  };
}

/**
 * @param {PageLabel} label
 * @param {Desk} desk
 */
function boxRow(label, desk) {
  const problem = desk.problemOf(label.uid);
  const state = problem ? "not saved" : label.isNew ? "new" : label.state;
  return h(
    "li",
    {},
    h(
      "button",
      {
        type: "button",
        class: "quiet row-button",
        "aria-current": label.uid === desk.uid ? "true" : null,
        title: problem ? `Not saved. ${problem}` : null,
        onclick: () => desk.select(label.uid),
        "data-testid": "frame-box",
        "data-uid": label.uid,
        "data-state": label.state,
      },
      h("span", { class: `dot state-${label.state}`, "aria-hidden": "true" }),
      h("span", { class: "ellipsis grow" }, shortName(label)),
      h("span", { class: problem ? "bad" : `state-${label.state}` }, state),
    ),
  );
}
