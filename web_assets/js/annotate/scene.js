/** The 3D view of the open frame: points, all boxes, and a gizmo on the selected box. */

import { h } from "../dom.js";

/** Minimum time between updates for changes by others, ms; without a graphics card, one takes a third of a second. */
const CALM_MS = { card: 300, software: 2500, none: 0 };

export function createScene(/** @type {Annotate} */ at) {
  const { app, desk } = at;
  const body = h("div.viewport-host");
  at.parts.scene.append(body);
  const { viewport } = app;
  /** @type {Api.Gizmo} */
  let gizmo = "off";
  let isDragging = false;
  /** A frame that cannot be read; the 3D view shows the reason, too. @type {number | null} */
  let broken = null;
  /**
   * The scene that was sent last, with the frame's revision and the time.
   *
   * @type {{ scene: string, revision: number | null, at: number }}
   */
  let sent = { scene: "", revision: null, at: -Infinity };
  let timer = 0;
  viewport.attach(body, {
    onSelect: desk.select,
    onBox({ uid, box, final }) {
      if (uid !== desk.uid) return;
      // the gizmo has moved away from what was sent
      sent.scene = "";
      isDragging = !final;
      desk.preview({ box });
      if (final) void desk.commit();
    },
  });

  /**
   * Sends the scene, unless it was sent already: without a graphics card, drawing takes time. If only the stored
   * labels have changed, as when others save, there is a pause between two updates.
   */
  function send() {
    clearTimeout(timer);
    const id = app.state.frame?.frame.id ?? broken;
    const revision = app.state.frame?.frame.revision ?? null;
    const { shown } = desk;
    const others = desk.labels().filter(({ uid, isNew }) => isNew && uid !== desk.uid);
    const previews = others.map((label) => ({ uid: label.uid, box: desk.seen(label).box }));
    if (shown && (desk.hasDraft || shown.isNew)) previews.push({ uid: shown.uid, box: shown.box });
    /** @type {Scene3D} */
    const scene = {
      frame: id,
      selected: desk.uid,
      previews,
      draft: at.teach.sceneDraft(),
      gizmo: gizmo === "off" ? "faces" : gizmo,
    };
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

  at.until.addEventListener("abort", () => clearTimeout(timer));
  return {
    get gizmo() {
      return gizmo;
    },
    setGizmo(/** @type {Api.Gizmo} */ mode) {
      gizmo = mode;
      send();
      at.actions.show();
    },
    show: send,
    fail(/** @type {number | null} */ frame) {
      broken = frame;
    },

    /** The box is being changed. During a drag of the gizmo, the 3D view already shows it. */
    preview() {
      if (!isDragging) send();
    },
  };
}
