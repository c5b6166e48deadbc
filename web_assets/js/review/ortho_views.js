/**
 * Three orthogonal pictures along the selected box's own axes. Its edges and corners are dragged and its rotation handle is
 * turned in each of them; the other two, the image and the 3D view follow without a round trip. When the mouse is let go,
 * the box is saved and new pictures along its new axes are fetched.
 */

import { boxAxis, copyBox, sameBox, turnedInView, viewOutline, viewRect, withViewRect } from "../box3d.js";
import { h } from "../dom.js";
import { createEditor } from "../editor2d/editor.js";
import { dot } from "../rotation.js";
import { STATE_COLORS, viewHeading } from "./drawing.js";

const SIZE_PX = 320;
const TITLES = { top: "Top", front: "Front", side: "Side" };
const NAMES = Object.keys(TITLES);
/** A box that is turned further from a view's axes is shown by its wire frame, not by a rectangle. */
const ALIGNED = Math.cos((0.2 * Math.PI) / 180);

export function createOrthoViews(host, app, desk) {
  const panels = NAMES.map((name) => createPanel(name, desk));
  host.append(...panels.map(({ root }) => root));
  let fetched = null;
  let request = null;

  /** New pictures for the box as it is now, unless there are some already. */
  async function fetchPictures() {
    const box = desk.shown?.box;
    const frame = app.state.frame?.frame.id;
    if (!box || panels.some(({ isDragging }) => isDragging())) return;
    if (fetched && fetched.frame === frame && sameBox(fetched.box, box)) return;
    request?.abort();
    request = new AbortController();
    const mine = { frame, box: copyBox(box) };
    host.dataset.shown = "";
    fetched = mine;
    try {
      const { views } = await app.api.post(app.path("frames", frame, "ortho"), { box, size_px: SIZE_PX }, { signal: request.signal });
      if (fetched !== mine) return;
      const shown = await Promise.all(panels.map((panel) => panel.setView(views.find(({ name }) => name === panel.name))));
      if (fetched !== mine) return;
      if (!shown.every(Boolean)) fetched = null;
      else host.dataset.shown = desk.uid ?? "";
    } catch (error) {
      if (fetched === mine) fetched = null;
      if (error.name === "AbortError") return;
      panels.forEach((panel) => panel.setProblem(error.message));
    }
  }

  desk.onLeave(() => panels.forEach((panel) => panel.leave()));

  return {
    /** The box is another one, or was saved. */
    async show() {
      if (!desk.shown) {
        request?.abort();
        fetched = null;
      }
      if (!app.state.frame) panels.forEach((panel) => panel.clear());
      panels.forEach((panel) => panel.follow());
      await fetchPictures();
    },

    /** The box moves under the mouse. */
    follow: () => panels.forEach((panel) => panel.follow()),

    /** Gives up the drag that is going on; false where there is none. */
    cancel: () => panels.some(({ editor }) => editor.isDragging && editor.cancel()),

    fit: () => panels.forEach(({ editor }) => editor.fit()),

    /** Passes a key to the view that has the focus; true where it was its own. */
    key: (event) => panels.find(({ editor }) => editor.root === document.activeElement)?.editor.key(event) ?? false,

    destroy() {
      request?.abort();
      panels.forEach(({ editor }) => editor.destroy());
    },
  };
}

function createPanel(name, desk) {
  const note = h("p", { class: "view-note", role: "alert", hidden: true });
  const body = h("div", { class: "view-body" }, note);
  const scale = h("span", { class: "muted number" });
  const root = h("section", { class: "panel ortho", "data-testid": `ortho-${name}`, "aria-label": `${TITLES[name]} view` }, h("header", {}, h("h3", {}, TITLES[name]), h("span", { class: "grow" }), scale), body);
  let view = null;
  let start = null;

  const editor = createEditor(body, {
    label: `${TITLES[name]} view of the selected box`,
    single: true,
    canDraw: false,
    canDelete: false,
    clip: false,
    color: () => STATE_COLORS[desk.shown?.state] ?? STATE_COLORS.proposed,
    onDrag([rect]) {
      if (!view || !rect || !desk.shown) return;
      begin();
      desk.preview({ box: withViewRect(view, start, rect) });
    },
    onChange(_, __, ___, actions) {
      end();
      if (desk.hasDraft) void desk.commit(actions);
      else follow();
    },
    onRotate(angle_rad, final) {
      if (!view || !desk.shown) return;
      begin();
      desk.preview({ box: turnedInView(view, start, angle_rad) });
      if (!final) return;
      end();
      void desk.commit();
    },
  });
  editor.setHandles({ edges: true, corners: true, rotate: true });

  let is_pointer = false;
  editor.root.addEventListener("pointerdown", () => (is_pointer = true), { capture: true });
  editor.root.addEventListener("keydown", () => (is_pointer = false), { capture: true });

  /** From here on the editor has the box: what is done is measured from the box as it was. */
  function begin() {
    start ??= copyBox(desk.shown.box);
    // A drag that was given up, or that moved nothing, is followed by no change; presses of the arrow keys are, later.
    if (is_pointer && !editor.isDragging) queueMicrotask(() => start && !editor.isDragging && (end(), follow()));
  }

  function end() {
    start = null;
  }

  function follow() {
    const box = desk.shown?.box;
    root.classList.toggle("idle", !box);
    if (start && box) {
      // the editor draws the rectangle itself
      editor.setOverlays(headingOf(box));
    } else if (!view || !box) {
      editor.setBoxes([]);
      editor.setOverlays([]);
    } else if (isAligned(view, box)) {
      editor.setBoxes([{ ...viewRect(view, box), caption: "" }], 0);
      editor.setOverlays(headingOf(box));
    } else {
      editor.setBoxes([]);
      editor.setOverlays([{ segments: viewOutline(view, box), color: STATE_COLORS[desk.shown.state] }, ...headingOf(box)]);
    }
  }

  const headingOf = (box) => viewHeading(view, box, STATE_COLORS[desk.shown.state]);

  return {
    name,
    root,
    editor,
    isDragging: () => start !== null || editor.isDragging,
    follow,

    /** Presses of the arrow keys count; a drag in the middle does not. */
    leave() {
      editor.flush();
      if (editor.isDragging) {
        editor.cancel();
        desk.revert();
      }
      end();
    },

    /** False where there was no time for it: a drag goes on, or another picture has come. */
    async setView(fresh) {
      note.hidden = true;
      if (start || editor.isDragging) return false;
      // the picture and the box on it change together
      if (!(await editor.setPicture(fresh.url, fresh.width, fresh.height))) return false;
      if (editor.isDragging) {
        // begun on the picture before: its pixels are others
        editor.cancel();
        desk.revert();
        end();
      }
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

    setProblem(message) {
      note.textContent = message;
      note.hidden = false;
    },
  };
}

/** Whether each of the view's axes lies along one of the box's. */
function isAligned(view, box) {
  return [0, 1].every((i) => [0, 1, 2].some((k) => Math.abs(dot(view.axes[i], boxAxis(box, k))) > ALIGNED));
}
