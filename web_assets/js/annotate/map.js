/**
 * The top view: a map of the frame's points, seen against gravity, with the boxes of the frame. It is moved and zoomed
 * without end; the server draws the part that is looked at. A click selects a box, or places one of the chosen class; a
 * drag moves the selected box, and its handle turns it.
 */

import { boxAxis, copyBox, corners, toView, turned } from "../box3d.js";
import { cameraOf } from "../camera.js";
import { STATE_COLORS } from "../colors.js";
import { button, h, s } from "../dom.js";
import { hull, isInHull } from "../editor2d/geometry.js";
import { dragOrClick } from "../editor2d/gestures.js";
import { listenToPointers } from "../editor2d/pointers.js";
import { add, scale, sceneAxes, transpose } from "../rotation.js";
import { shortName } from "./drawing.js";

/** Whether it is shown in place of the 3D view. */
const KEPT = "top-view";
/** The part that is looked at is drawn after so long a rest, ms. */
const REST_MS = 60;
/** Rings are this far apart on the screen at least, px. */
const RING_PX = 70;
const STEPS_M = [1, 2, 5, 10, 20, 50, 100];
const HANDLE_PX = 16;
/** How near to the handle a pointer means it, px. */
const REACH_PX = 10;
const LIMITS_M_PER_PX = [0.002, 2];
/** Metres in front of the sensor that are shown first, at most, and if there are no points. */
const FURTHEST_M = 60;
/** The axes of the map: right, down on the screen, and into it, that is with gravity. */
function mapAxes(/** @type {Vector | null} */ up) {
  const [forward, left, above] = transpose(sceneAxes(up));
  return [left, forward, above].map((axis) => scale(axis, -1));
}

export function createMap(/** @type {Annotate} */ at) {
  const { app, desk, parts } = at;
  const picture = h("img.picture", { alt: "", draggable: "false" });
  const svg = s("svg.shapes", { "aria-hidden": "true" });
  const root = h(
    "div.map",
    { tabindex: 0, role: "application", "aria-label": "Top view", "data-testid": "map" },
    picture,
    svg,
  );
  parts.map.append(
    h(
      "header",
      h("h2", "Top view"),
      h("span.muted.ellipsis.grow", "Drag to move, wheel to zoom, click to select or place."),
      button(["3D view", h("kbd", "M")], () => turn(false), { class: "quiet small", "data-testid": "show-3d" }),
    ),
    root,
  );
  parts.sceneHead.append(
    h("h2", "3D view"),
    at.actions.gizmo,
    h("span.grow"),
    button(["Top view", h("kbd", "M")], () => turn(true), {
      class: "quiet small",
      title: "A map: click to place a box, drag to move it (M)",
      "data-testid": "show-map",
    }),
  );
  /** The plane in pixels of the window: the view of box3d.js. @type {Plane} */
  let plane = { axes: mapAxes(null), origin_m: [0, 0], metres_per_px: 0.1 };
  /** The plane of the picture that is shown. @type {Plane | null} */
  let drawn = null;
  const size = { width: 0, height: 0 };
  /** The recording that is shown: another one is fitted anew. @type {number | null} */
  let recording = null;
  let reachM = 0;
  let timer = 0;
  let asked = "";
  let isShown = false;

  /** Shows what is in front of the sensor, as far as most points reach. */
  function fit() {
    const metres = Math.min(reachM || FURTHEST_M, FURTHEST_M) / Math.max(size.height * 0.85, 1);
    plane = {
      axes: mapAxes(app.state.frame?.up ?? null),
      metres_per_px: metres,
      origin_m: [(-metres * size.width) / 2, -metres * size.height * 0.85],
    };
  }

  async function open(/** @type {Api.FrameJson} */ frame) {
    recording = frame.recording;
    reachM = await app.api.get(app.path("frames", frame.id, "reach"));
    if (recording !== frame.recording) return;
    fit();
    look();
  }

  /** The part that is looked at has changed. */
  function look() {
    draw();
    clearTimeout(timer);
    timer = setTimeout(ask, REST_MS);
  }

  async function ask() {
    const frame = app.state.frame;
    if (!frame || !isShown || !size.width) return;
    const [right, down] = plane.axes;
    const query = new URLSearchParams([
      ...right.map((value) => ["right", value.toFixed(7)]),
      ...down.map((value) => ["down", value.toFixed(7)]),
      ["left_m", String(plane.origin_m[0])],
      ["top_m", String(plane.origin_m[1])],
      ["metres_per_px", String(plane.metres_per_px)],
      ["width", String(Math.round(size.width))],
      ["height", String(Math.round(size.height))],
      ["v", new URLSearchParams(frame.image.url.split("?")[1]).get("v") ?? ""],
    ]);
    const url = `${app.path("frames", frame.frame.id, "map.png")}?${query}`;
    if (url === asked) return;
    asked = url;
    const own = { ...plane };
    const fresh = new Image();
    fresh.src = url;
    await fresh.decode().catch(() => null);
    if (asked !== url) return;
    picture.src = url;
    drawn = own;
    draw();
  }

  function draw() {
    const frame = app.state.frame;
    svg.setAttribute("viewBox", `0 0 ${size.width} ${size.height}`);
    if (drawn) {
      const zoom = drawn.metres_per_px / plane.metres_per_px;
      const [x, y] = [0, 1].map((i) => (drawn ? drawn.origin_m[i] - plane.origin_m[i] : 0) / plane.metres_per_px);
      picture.style.transform = `translate(${x}px, ${y}px) scale(${zoom})`;
    }
    svg.replaceChildren(...(frame ? [...rings(), ...sides(frame), ...boxes()] : []));
  }

  function rings() {
    const step = STEPS_M.find((metres) => metres / plane.metres_per_px > RING_PX) ?? 200;
    const [x, y] = toView(plane, [0, 0, 0]);
    const furthest = Math.hypot(Math.max(x, size.width - x), Math.max(y, size.height - y)) * plane.metres_per_px;
    /** @type {SVGElement[]} */
    const marks = [s("circle.sensor", { cx: x, cy: y, r: 4 })];
    for (let metres = step; metres < furthest && marks.length < 60; metres += step) {
      const r = metres / plane.metres_per_px;
      marks.push(s("circle.ring", { cx: x, cy: y, r }));
      marks.push(s("text.ring", { x: x + 3, y: y - r - 3 }, `${metres} m`));
    }
    return marks;
  }

  /** The sides of what the camera sees. */
  function sides(/** @type {FrameState} */ { image }) {
    const { fx, cx, width } = cameraOf(image);
    const from = toView(plane, [0, 0, 0]);
    return [-0.5, width - 0.5].map((px) => {
      const far = 200 / plane.metres_per_px;
      const to = toView(plane, [(px - cx) / fx, 0, 1]).map((value, i) => value - from[i]);
      const share = far / Math.hypot(...to);
      const [x2, y2] = to.map((value, i) => from[i] + value * share);
      return s("line.side", { x1: from[0], y1: from[1], x2, y2 });
    });
  }

  const seen = () => desk.labels().filter(({ state, uid }) => state !== "rejected" || uid === desk.uid);
  const outlineOf = (/** @type {Box3D} */ box) => hull(corners(box).map((corner) => toView(plane, corner)));

  /** The middle, the front and the handle of a box. */
  function arrowOf(/** @type {Box3D} */ box) {
    const [from, to] = [0, 0.5].map((share) =>
      toView(plane, add(box.center, scale(boxAxis(box, 0), share * box.size[0]))),
    );
    const far = Math.hypot(to[0] - from[0], to[1] - from[1]) || 1;
    return { from, to, handle: to.map((value, i) => value + ((value - from[i]) / far) * HANDLE_PX) };
  }

  function boxes() {
    return seen().flatMap((label) => {
      const { box } = desk.seen(label);
      const isSelected = label.uid === desk.uid;
      const color = STATE_COLORS[label.state];
      const { from, to, handle } = arrowOf(box);
      const group = s(
        "g",
        { class: isSelected ? "box selected" : "box", "data-testid": "map-box", "data-id": label.uid },
        s("polygon", {
          points: outlineOf(box)
            .map((point) => point.join(","))
            .join(" "),
          stroke: color,
          fill: isSelected ? color : "transparent",
          "stroke-dasharray": label.isNew ? "5 3" : "none",
        }),
        s("line", { x1: from[0], y1: from[1], x2: to[0], y2: to[1], stroke: color }),
        s("title", shortName(label, desk.labels())),
      );
      if (isSelected && !app.state.frame?.frame.finalised)
        group.append(s("circle.handle", { cx: handle[0], cy: handle[1], r: 6, "data-testid": "map-handle" }));
      return [group];
    });
  }

  // -- the pointer: positions on the map are metres along its axes

  const pointOf = (/** @type {Point} */ [x, y]) => add(scale(plane.axes[0], x), scale(plane.axes[1], y));
  const boxAt = (/** @type {Point} */ at) =>
    seen().find((label) => isInHull(outlineOf(desk.seen(label).box), toView(plane, pointOf(at))));

  const view = {
    toPicture: (/** @type {Point} */ at) => at.map((value, i) => plane.origin_m[i] + value * plane.metres_per_px),
    panBy(/** @type {number} */ dx, /** @type {number} */ dy) {
      const m = plane.metres_per_px;
      plane = { ...plane, origin_m: [plane.origin_m[0] - dx * m, plane.origin_m[1] - dy * m] };
    },
    zoomAbout(/** @type {Point} */ at, /** @type {number} */ factor) {
      const metres = Math.min(Math.max(plane.metres_per_px / factor, LIMITS_M_PER_PX[0]), LIMITS_M_PER_PX[1]);
      const origin = at.map((value, i) => plane.origin_m[i] + value * (plane.metres_per_px - metres));
      plane = { ...plane, metres_per_px: metres, origin_m: origin };
    },
  };

  /** What a pointer changes of the selected box; "draw": a click places one. @returns {Hit} */
  function hit(/** @type {Point} */ at) {
    const box = desk.shown?.box;
    const [x, y] = toView(plane, pointOf(at));
    const handle = box && arrowOf(box).handle;
    if (app.state.frame?.frame.finalised) return { kind: "nothing", index: -1 };
    if (handle && Math.hypot(x - handle[0], y - handle[1]) < REACH_PX) return { kind: "turn", index: -1 };
    return { kind: box && isInHull(outlineOf(box), [x, y]) ? "move" : "draw", index: -1 };
  }

  function begin(/** @type {Hit} */ { kind }, /** @type {Point} */ from, /** @type {Point} */ start) {
    const box = (kind === "turn" || kind === "move") && desk.shown ? copyBox(desk.shown.box) : null;
    const middle = box && view.toPicture(toView(plane, box.center));
    const angle = (/** @type {Point} */ [x, y]) => (middle ? Math.atan2(y - middle[1], x - middle[0]) : 0);
    let last = start;
    let isEdited = false;
    return dragOrClick(start, {
      move(here, point) {
        if (!box) {
          view.panBy(point[0] - last[0], point[1] - last[1]);
          look();
        } else if (kind === "turn") desk.preview({ box: turned(box, plane.axes[2], angle(here) - angle(from)) });
        else
          desk.preview({ box: { ...box, center: add(box.center, pointOf([here[0] - from[0], here[1] - from[1]])) } });
        isEdited = box !== null;
        last = point;
      },
      finish: () => void (isEdited && desk.commit()),
      cancel: () => void (isEdited && desk.hasDraft && desk.revert()),
      click() {
        const hit = boxAt(from);
        if (hit) desk.select(hit.uid);
        else void at.commands.placeAt(pointOf(from));
      },
    });
  }

  const pointers = listenToPointers({ root, size, view, until: at.until, redraw: look, hit, begin });
  // another box is selected: the drag was of the one before
  desk.onLeave(pointers.cancel);
  root.addEventListener("dblclick", (event) => {
    const hit = boxAt(view.toPicture(pointers.windowPoint(event)));
    if (hit) at.showBest(hit.uid);
  });
  const watcher = new ResizeObserver(([{ contentRect }]) => {
    const isFirst = !size.width;
    Object.assign(size, { width: contentRect.width, height: contentRect.height });
    if (isFirst) fit();
    look();
  });
  watcher.observe(root);
  at.until.addEventListener("abort", () => {
    clearTimeout(timer);
    watcher.disconnect();
  });

  /** Shows the map in place of the 3D view, or this one again. */
  function turn(/** @type {boolean} */ on) {
    localStorage.setItem(KEPT, String(on));
    isShown = on;
    parts.map.hidden = !on;
    parts.scene.hidden = on;
    show();
  }

  /** Another frame, box or selection. */
  function show() {
    const frame = app.state.frame?.frame;
    if (!isShown || !frame) return;
    if (frame.recording !== recording) void open(frame);
    else look();
  }

  turn(localStorage.getItem(KEPT) === "true");
  return {
    get isShown() {
      return isShown;
    },
    turn,
    show,
    cancel: pointers.cancel,
    fit() {
      fit();
      look();
    },
  };
}
