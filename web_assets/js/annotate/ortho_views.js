/**
 * Three orthogonal pictures along the selected box's axes. In each of them the box's edges, corners and rotation
 * handle can be dragged; the other two, the image and the 3D view follow without a request. At the end of a drag the
 * box is saved, and new pictures along its new axes are fetched.
 */

import {
  boxAxis,
  copyBox,
  headingJump,
  sameBox,
  turned,
  viewHeading,
  viewOutline,
  viewRect,
  withViewRect,
} from "../box3d.js";
import { STATE_COLORS } from "../colors.js";
import { h } from "../dom.js";
import { createEditor } from "../editor2d/editor.js";
import { isAborted, messageOf } from "../errors.js";
import { dot } from "../rotation.js";

export const SIZE_PX = 320;
/** The title of each view, and from where it is seen, which the heading's arrow shows, too. */
const VIEWS = {
  top: ["Top", "Seen from above: the front is up, the left side on the left."],
  front: ["Front", "Seen from the front, against the heading: the left side is on the right."],
  side: ["Right side", "Seen from its right: the front is on the right."],
};
/** @typedef {keyof typeof VIEWS} Name */

/** A box whose axes differ from the view's by more than this is drawn as its 12 edges, not as a rectangle. */
const ALIGNED = Math.cos((0.2 * Math.PI) / 180);

/** Share of the line of sight that lies in a view on which it can be dragged. */
const FLAT = 0.7;

export function createOrthoViews(/** @type {Annotate} */ at) {
  const { app, desk, preload } = at;
  const host = at.parts.ortho;
  const panels = /** @type {Name[]} */ (Object.keys(VIEWS)).map((name) => createPanel(name, at));
  const note = h("p.note", "A box is seen here from above, from the front and from its right.");
  host.append(...panels.map(({ root }) => root), note);
  /** @type {{ frame: number, box: Box3D } | null} */
  let fetched = null;
  /** @type {AbortController | null} */
  let request = null;

  /** Fetches pictures for the box as it is now, unless they are shown already. */
  async function fetchPictures() {
    const box = desk.shown?.box;
    const frame = app.state.frame?.frame.id;
    if (!box || frame === undefined || panels.some(({ editor }) => editor.isDragging)) return;
    if (fetched && fetched.frame === frame && sameBox(fetched.box, box)) return;
    request?.abort();
    request = new AbortController();
    const mine = { frame, box: copyBox(box) };
    host.dataset.shown = "";
    fetched = mine;
    try {
      preload.stop();
      /** @type {Api.OrthoView[]} */
      const views =
        preload.take(frame, box) ??
        (await app.api.post(
          app.path("frames", frame, "ortho"),
          { box, size_px: SIZE_PX },
          { signal: request.signal },
        ));
      if (fetched !== mine) return;
      const shown = await Promise.all(
        panels.map((panel) => {
          const view = views.find(({ name }) => name === panel.name);
          return view ? panel.setView(view) : false;
        }),
      );
      if (fetched !== mine) return;
      if (!shown.every(Boolean)) fetched = null;
      else {
        host.dataset.shown = desk.uid ?? "";
        void preload.start();
      }
    } catch (error) {
      if (fetched === mine) fetched = null;
      if (isAborted(error)) return;
      for (const panel of panels) panel.setProblem(messageOf(error));
    }
  }

  at.until.addEventListener("abort", () => request?.abort());
  desk.onLeave(() => {
    for (const panel of panels) panel.leave();
  });

  return {
    /** Another box was selected, or the box was saved. */
    async show() {
      if (!desk.shown) {
        request?.abort();
        fetched = null;
        void preload.start();
      }
      for (const panel of panels) {
        if (!app.state.frame) panel.clear();
        panel.follow();
      }
      await fetchPictures();
    },

    /** The box is being dragged. */
    follow() {
      for (const panel of panels) panel.follow();
    },

    /** Cancels the drag in progress; false if there is none. */
    cancel: () => panels.some(({ editor }) => editor.cancel()),

    fit() {
      for (const { editor } of panels) editor.fit();
    },
  };
}

function createPanel(/** @type {Name} */ name, /** @type {Annotate} */ { desk, until }) {
  const [title, seen] = VIEWS[name];
  const note = h("p.view-note", { role: "alert", hidden: true });
  const body = h("div.view-body", note);
  const scale = h("span.muted.number");
  const root = h(
    "section.panel.ortho",
    { "data-testid": `ortho-${name}`, "aria-label": `${title} view` },
    h("header", h("h3", { title: seen }, title), h("span.grow"), scale),
    body,
  );
  /** @type {Api.OrthoView | null} */
  let view = null;
  /** The box before the edit that is in progress. @type {Box3D | null} */
  let start = null;

  const color = () => STATE_COLORS[desk.shown?.state ?? "proposed"];

  const editor = createEditor(body, {
    label: `${title} view of the selected box`,
    single: true,
    until,
    canDraw: () => false,
    clip: false,
    color,
    onDrag([rect]) {
      const plane = view;
      if (plane && rect) preview((box) => withViewRect(plane, box, rect));
    },
    onChange(_boxes, _why, _index, actions) {
      if (desk.hasDraft) void desk.commit(actions);
      end();
    },
    onPull(handle, by, isFinal) {
      const plane = view;
      if (plane) preview((box) => (handle === "turn" ? turned(box, plane.axes[2], by) : slid(box, by)));
      if (isFinal) void desk.commit();
    },
    onEnd: end,
  });

  /** Shows the selected box as an edit makes it of what it was before. The editor draws it meanwhile. */
  function preview(/** @type {(before: Box3D) => Box3D} */ edit) {
    if (!desk.shown) return;
    start ??= copyBox(desk.shown.box);
    desk.preview({ box: edit(start) });
  }

  function end() {
    start = null;
    follow();
  }

  /** @returns {Overlay} */
  const heading = (/** @type {Plane} */ plane, /** @type {Box3D} */ box) => ({
    segments: [],
    heading: viewHeading(plane, box),
    color: color(),
    strong: true,
    wrong: desk.shown !== null && headingJump(desk.shown) !== null,
  });

  function follow() {
    const box = desk.shown?.box;
    root.classList.toggle("idle", !box);
    if (!view || !box) {
      editor.setBoxes([]);
      editor.setOverlays([]);
    } else if (start) {
      // the editor draws the rectangle itself
      editor.setOverlays([heading(view, box)], editor.sight);
    } else if (isAligned(view, box)) {
      editor.setBoxes([{ ...viewRect(view, box), label: "", caption: "" }], 0);
      editor.setOverlays([heading(view, box)], sightOn(view, box));
    } else {
      editor.setBoxes([]);
      editor.setOverlays([{ ...heading(view, box), segments: viewOutline(view, box), strong: false }]);
    }
  }

  /** Saves arrow keys that were pressed; cancels a drag in progress. */
  function leave() {
    editor.flush();
    if (editor.cancel() && desk.hasDraft) desk.revert();
  }

  return {
    name,
    root,
    editor,
    follow,
    leave,

    /** Shows a new view. Resolves to false if it is not shown: during a drag, or if a newer one has replaced it. */
    async setView(/** @type {Api.OrthoView} */ fresh) {
      note.hidden = true;
      if (editor.isDragging) return false;
      // the picture and the box on it change together
      if (!(await editor.setPicture(fresh.url, fresh.width, fresh.height))) return false;
      // a drag that began on the previous picture, which has other pixels
      leave();
      view = fresh;
      scale.textContent = `${(fresh.metres_per_px * fresh.width).toFixed(2)} m wide`;
      editor.fit();
      follow();
      return true;
    },

    clear() {
      view = null;
      note.hidden = true;
      scale.textContent = "";
      void editor.setPicture(null);
    },

    setProblem(/** @type {string} */ message) {
      note.textContent = message;
      note.hidden = false;
    },
  };
}

/** True if each of the view's axes is parallel to one of the box's. */
function isAligned(/** @type {Plane} */ view, /** @type {Box3D} */ box) {
  return [0, 1].every((i) => [0, 1, 2].some((k) => Math.abs(dot(view.axes[i], boxAxis(box, k))) > ALIGNED));
}

/** A box moved along the line of sight from the camera, metres; it stays in front of the camera. */
function slid(/** @type {Box3D} */ box, /** @type {number} */ metres) {
  const distance = Math.hypot(...box.center);
  const scale = Math.max(distance + metres, 0.1) / distance;
  return { ...copyBox(box), center: box.center.map((value) => value * scale) };
}

/** The line of sight to a box on a view, px for each metre; null where it leaves the view steeply. @returns {Point | null} */
function sightOn(/** @type {Plane} */ view, /** @type {Box3D} */ box) {
  const distance = Math.hypot(...box.center);
  const along = [0, 1].map((i) => dot(view.axes[i], box.center) / distance);
  return Math.hypot(...along) < FLAT ? null : along.map((value) => value / view.metres_per_px);
}
