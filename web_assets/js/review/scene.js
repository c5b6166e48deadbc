/** The 3D view of the open frame: cloud, all boxes, and a gizmo on the selected one. */

import { h } from "../dom.js";

const COLORS = [["rgb", "Colour"], ["depth", "Depth"], ["height", "Height"], ["intensity", "Intensity"]];
const POINT_LIMITS = [0.1, 10];
/** What others save comes into the 3D view no more often than this, ms; a processor draws for a third of a second. */
const CALM_MS = { card: 300, software: 2500, none: 0 };

export function createScene(host, app, desk) {
  const body = h("div", { class: "viewport-host" });
  const note = h("span", { class: "muted number", "data-testid": "viewport-points" });
  const color = h("select", { "aria-label": "Colour of the points", title: "Colour of the points", onchange: () => color.blur() ?? choose("color", color.value) }, COLORS.map(([value, text]) => h("option", { value }, text)));
  const reset = h("button", { type: "button", class: "quiet small", title: "Back to the camera's place", "data-testid": "reset-view", onclick: () => send({ reset_view: true }) }, "Reset view");
  host.append(h("header", {}, h("h2", {}, "3D view"), note, h("span", { class: "grow" }), color, reset), body);
  const { viewport } = app;
  const chosen = { gizmo: "off", color: "rgb", point_size: 1 };
  let is_dragging = false;
  /** A frame that cannot be read: the 3D view says why, too. */
  let broken = null;
  /** What was sent last: the scene, the revision that it shows, and when. */
  let sent = { scene: "", revision: null, at: -Infinity };
  let timer = 0;
  if (!viewport) {
    body.append(h("p", { class: "view-note" }, "The 3D view could not be loaded. Reload the page to try again."));
    return { gizmo: "off", setGizmo() {}, show() {}, fail() {}, preview() {}, points() {}, destroy() {} };
  }
  body.append(viewport.element);

  const stop = [
    viewport.on("select", ({ uid }) => desk.select(uid)),
    viewport.on("shown", ({ shown_points, points }) => (note.textContent = shown_points < points ? `${shown_points.toLocaleString("en")} of ${points.toLocaleString("en")} points` : `${points.toLocaleString("en")} points`)),
    viewport.on("box", ({ uid, box, final }) => {
      if (uid !== desk.uid) return;
      // the gizmo has moved away from what was sent
      sent.scene = "";
      is_dragging = !final;
      desk.preview({ box });
      if (final) void desk.commit();
    }),
  ];

  /**
   * What is shown already is not sent again: without a graphics card each drawing of the cloud takes time. Where nothing but
   * the labels has changed, as when others save, it comes at a calm pace.
   */
  function send(more = {}) {
    clearTimeout(timer);
    const { id = broken, revision = null } = app.state.frame?.frame ?? {};
    const preview = desk.hasDraft || desk.shown?.is_new ? { uid: desk.uid, box: desk.shown.box } : null;
    const others = desk.labels().filter(({ uid, is_new }) => is_new && uid !== desk.uid);
    const added = others.map((label) => ({ uid: label.uid, box: desk.seen(label).box }));
    const scene = { frame: id, selected: desk.uid, labels: "all", preview, added, ...chosen, ...more };
    const text = JSON.stringify(scene);
    if (text === sent.scene && revision === sent.revision) return;
    const wait_ms = text === sent.scene ? sent.at + CALM_MS[viewport.graphics] - performance.now() : 0;
    if (wait_ms > 0) {
      timer = setTimeout(send, wait_ms);
      return;
    }
    viewport.show(scene);
    sent = { scene: text, revision, at: performance.now() };
  }

  function choose(name, value) {
    if (chosen[name] === value) return;
    chosen[name] = value;
    send();
  }

  return {
    get gizmo() {
      return chosen.gizmo;
    },
    setGizmo: (mode) => choose("gizmo", mode),
    show: () => send(),
    fail: (frame) => (broken = frame),

    /** The box moves; where it is the gizmo that moves it, the 3D view knows already. */
    preview() {
      if (!is_dragging) send();
    },

    /** Larger or smaller points, by a factor. */
    points: (factor) => choose("point_size", Math.min(Math.max(chosen.point_size * factor, POINT_LIMITS[0]), POINT_LIMITS[1])),

    destroy() {
      clearTimeout(timer);
      stop.forEach((end) => end());
    },
  };
}
