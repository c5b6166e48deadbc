/** The 3D view of the open frame: points, all boxes, and a gizmo on the selected box. */

import { button, h } from "../dom.js";

/** @type {[Api.PointColor, string][]} */
const COLORS = [
  ["rgb", "Colour"],
  ["depth", "Depth"],
  ["height", "Height"],
  ["intensity", "Intensity"],
];
const POINT_LIMITS = [0.1, 10];
/** Minimum time between updates for changes by others, ms; without a graphics card, one takes a third of a second. */
const CALM_MS = { card: 300, software: 2500, none: 0 };

export function createScene(
  /** @type {HTMLElement} */ host,
  /** @type {ModeApp} */ app,
  /** @type {Desk} */ desk,
  /** @type {{ teach: () => Teach, onMap: () => void }} */ { teach, onMap },
) {
  const body = h("div", { class: "viewport-host" });
  const note = h("span", { class: "muted number", "data-testid": "viewport-points" });
  /** @type {HTMLSelectElement} */
  const color = h(
    "select",
    {
      "aria-label": "Colour of the points",
      title: "Colour of the points",
      onchange() {
        color.blur();
        choose({ color: COLORS.find(([name]) => name === color.value)?.[0] });
      },
    },
    COLORS.map(([value, text]) => h("option", { value }, text)),
  );
  const reset = button("Reset view", () => send({ reset_view: true }), {
    class: "quiet small",
    title: "Look from the camera",
    "data-testid": "reset-view",
  });
  const topView = button(["Top view", h("kbd", {}, "M")], onMap, {
    class: "quiet small",
    title: "A map: click to place a box, drag to move it (M)",
    "data-testid": "show-map",
  });
  host.append(
    h("header", {}, h("h2", {}, "3D view"), note, h("span", { class: "grow" }), color, reset, topView),
    body,
  );
  const { viewport } = app;
  /** @type {{ gizmo: Api.Gizmo, color: Api.PointColor, point_size: number }} */
  const chosen = { gizmo: "off", color: "rgb", point_size: 1 };
  let isDragging = false;
  /**
   * A frame that cannot be read; the 3D view shows the reason, too.
   *
   * @type {number | null}
   */
  let broken = null;
  /**
   * The scene that was sent last, with the frame's revision and the time.
   *
   * @type {{ scene: string, revision: number | null, at: number }}
   */
  let sent = { scene: "", revision: null, at: -Infinity };
  let timer = 0;
  body.append(viewport.element);

  const stop = [
    viewport.on("select", ({ uid }) => desk.select(uid)),
    viewport.on(
      "shown",
      ({ shown_points, points }) =>
        (note.textContent =
          shown_points < points
            ? `${shown_points.toLocaleString("en")} of ${points.toLocaleString("en")} points`
            : `${points.toLocaleString("en")} points`),
    ),
    viewport.on("box", ({ uid, box, final }) => {
      if (uid !== desk.uid) return;
      // the gizmo has moved away from what was sent
      sent.scene = "";
      isDragging = !final;
      desk.preview({ box });
      if (final) void desk.commit();
    }),
  ];

  /**
   * Sends the scene, unless it was sent already: without a graphics card, drawing takes time. If only the stored
   * labels have changed, as when others save, there is a pause between two updates.
   */
  function send(/** @type {Partial<Scene3D>} */ more = {}) {
    clearTimeout(timer);
    const id = app.state.frame?.frame.id ?? broken;
    const revision = app.state.frame?.frame.revision ?? null;
    const { shown } = desk;
    const others = desk.labels().filter(({ uid, isNew }) => isNew && uid !== desk.uid);
    const previews = others.map((label) => ({ uid: label.uid, box: desk.seen(label).box }));
    if (shown && (desk.hasDraft || shown.isNew)) previews.push({ uid: shown.uid, box: shown.box });
    /** @type {Scene3D} */
    const scene = { frame: id, selected: desk.uid, previews, draft: teach().sceneDraft(), ...chosen, ...more };
    const text = JSON.stringify(scene);
    if (text === sent.scene && revision === sent.revision) return;
    const waitMs = text === sent.scene ? sent.at + CALM_MS[viewport.graphics] - performance.now() : 0;
    if (waitMs > 0) {
      timer = setTimeout(send, waitMs);
      return;
    }
    viewport.show(scene);
    sent = { scene: text, revision, at: performance.now() };
  }

  function choose(/** @type {Partial<typeof chosen>} */ changes) {
    Object.assign(chosen, changes);
    send();
  }

  return {
    get gizmo() {
      return chosen.gizmo;
    },
    setGizmo: (/** @type {Api.Gizmo} */ mode) => choose({ gizmo: mode }),
    show: () => send(),
    fail(/** @type {number | null} */ frame) {
      broken = frame;
    },

    /** The box is being changed. During a drag of the gizmo, the 3D view already shows it. */
    preview() {
      if (!isDragging) send();
    },

    /** Larger or smaller points, by a factor. */
    points: (/** @type {number} */ factor) =>
      choose({ point_size: Math.min(Math.max(chosen.point_size * factor, POINT_LIMITS[0]), POINT_LIMITS[1]) }),

    destroy() {
      clearTimeout(timer);
      for (const end of stop) end();
    },
  };
}
