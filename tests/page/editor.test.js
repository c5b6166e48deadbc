// The 2D editor without a display: boxes on a picture, what a drag does to them, and the picture in its window.

import assert from "node:assert/strict";
import { test } from "node:test";
import * as geometry from "../../web_assets/js/editor2d/geometry.js";
import { hitTest } from "../../web_assets/js/editor2d/gestures.js";
import { shortName } from "../../web_assets/js/annotate/drawing.js";
import { createView } from "../../web_assets/js/editor2d/geometry.js";

const SIZE = { width: 320, height: 240 };
const LIMITS = geometry.pictureLimits(SIZE, true);
const box = (left, top, right, bottom, more = {}) => {
  return { label: "person", x_min: left, y_min: top, x_max: right, y_max: bottom, ...more };
};
const edges = ({ x_min, y_min, x_max, y_max }) => [x_min, y_min, x_max, y_max];

const BOX = box(50, 60, 150, 120);

test("dragging an edge or a corner resizes the box, and an edge may cross the opposite one", () => {
  for (const [grab, drop, wanted] of [
    [
      [50, 90],
      [42, 97],
      [42, 60, 150, 120],
    ],
    [
      [150, 90],
      [171, 90],
      [50, 60, 171, 120],
    ],
    [
      [100, 60],
      [100, 44],
      [50, 44, 150, 120],
    ],
    [
      [100, 120],
      [90, 139],
      [50, 60, 150, 139],
    ],
    [
      [50, 60],
      [61, 72],
      [61, 72, 150, 120],
    ],
    [
      [150, 120],
      [163, 101],
      [50, 60, 163, 101],
    ],
    [
      [150, 60],
      [160, 50],
      [50, 50, 160, 120],
    ],
    [
      [150, 90],
      [20, 90],
      [20, 60, 50, 120],
    ],
    [
      [150, 90],
      [900, 90],
      [50, 60, 319.5, 120],
    ],
  ]) {
    const side = geometry.edgeNear(BOX, grab, 3);
    const after = geometry.resized(BOX, side.sideX, side.sideY, drop[0] - grab[0], drop[1] - grab[1], LIMITS);
    assert.deepEqual(edges(after), wanted);
    assert.equal(after.label, "person");
  }
});

test("an edge is near its whole length, but the inner half of a small box is not an edge", () => {
  assert.deepEqual(geometry.edgeNear(BOX, [52, 100], 3), { sideX: -1, sideY: 0 });
  assert.equal(geometry.edgeNear(BOX, [54, 100], 3), null);
  assert.equal(geometry.edgeNear(BOX, [52, 130], 3), null);
  assert.equal(geometry.edgeNear(box(50, 60, 54, 64), [52, 62], 3), null);
  assert.deepEqual(geometry.edgeNear(BOX, [50, 60], 3), { sideX: -1, sideY: -1 });
});

test("moving stops at the border, from which a box may come back", () => {
  assert.deepEqual(edges(geometry.moved(BOX, 12, -15, LIMITS)), [62, 45, 162, 105]);
  assert.deepEqual(edges(geometry.moved(BOX, -300, 0, LIMITS)), [-0.5, 60, 99.5, 120]);
  assert.deepEqual(edges(geometry.moved(box(-20, 0, 10, 9), 5, 0, LIMITS)), [-15, 0, 15, 9]);
  const free = geometry.pictureLimits(SIZE, false);
  assert.deepEqual(edges(geometry.moved(BOX, -300, 0, free)), [-250, 60, -150, 120]);
});

test("a box has a least side, and the corners of a drag may come in any order", () => {
  const thin = geometry.resized(BOX, 1, 0, -100, 0, LIMITS);
  assert.deepEqual([thin.x_min, thin.x_max], [50, 50.5]);
  assert.deepEqual(geometry.edgesBetween([9, 2], [3, 8]), { x_min: 3, y_min: 2, x_max: 9, y_max: 8 });
  assert.deepEqual(geometry.clampPoint([400, -9], LIMITS), [319.5, -0.5]);
});

test("a point is inside the hull of an outline", () => {
  const outline = geometry.hull([
    [0, 0],
    [4, 0],
    [4, 3],
    [0, 3],
    [2, 1],
  ]);
  assert.equal(outline.length, 4);
  assert.equal(geometry.area2(outline), 24);
  assert.ok(geometry.isInHull(outline, [1, 1]));
  assert.ok(!geometry.isInHull(outline, [5, 1]));
});

/** The inside of an editor, as far as a hit test looks at it; its first box is selected. */
const editorOf = (boxes, more = {}) => ({
  boxes,
  selected: 0,
  view: createView(SIZE, SIZE),
  sight: null,
  options: {},
  canDraw: () => true,
  isReadonly: false,
  ...more,
});

test("what lies under the pointer", () => {
  const editor = editorOf([BOX, box(200, 60, 240, 100)]);
  const hit = (point, ...more) => hitTest(editor, point, "mouse", ...more).kind;
  assert.equal(hit([100, 90]), "move");
  assert.equal(hit([50, 90]), "resize");
  assert.deepEqual(hitTest(editor, [200, 80], "mouse"), { kind: "resize", index: 1, sideX: -1, sideY: 0 });
  assert.equal(hit([220, 80]), "draw", "only a selected box is moved");
  assert.equal(hit([100, 90], true), "draw", "Shift draws over it");
  assert.equal(hitTest(editor, [40, 90], "touch").kind, "resize", "a finger reaches farther");
  assert.equal(hitTest(editorOf([BOX], { isReadonly: true }), [100, 90], "mouse").kind, "nothing");
  const turning = editorOf([BOX], { options: { onPull() {} } });
  assert.ok([...Array(60).keys()].some((up) => hitTest(turning, [100, 60 - up], "mouse").kind === "turn"));
});

test("zooming keeps the pixel under the pointer, and a strip of the picture stays in the window", () => {
  const size = { width: 700, height: 500 };
  const view = createView(SIZE, size);
  view.fit();
  assert.deepEqual(view.toWindow([159.5, 119.5]), [350, 250]);
  const pointer = view.toWindow([70, 60]);
  for (let i = 0; i < 40; i += 1) {
    view.zoomAbout(pointer, 1.2);
    const [x, y] = view.toPicture(pointer);
    assert.ok(Math.abs(x - 70) < 1e-9 && Math.abs(y - 60) < 1e-9);
  }
  assert.equal(view.scale, 64);
  view.fit();
  view.panBy(-1e6, 1e6);
  const [right, top] = [view.toWindow([319.5, 0])[0], view.toWindow([0, -0.5])[1]];
  assert.deepEqual([Math.round(right), Math.round(top)], [32, 500 - 32]);
  assert.equal(view.isFitted, false);
});

test("a box is named by its class and track; without one, a number tells those of a class apart", () => {
  const label = (uid, name, track = null, isNew = false) => ({ uid, label: name, track_id: track, isNew });
  const all = [
    label("18ec", "person"),
    label("ab07", "person", 3),
    label("77f0", "chair"),
    label("c1d2", "person"),
    label("new-1", "person", null, true),
  ];
  const names = all.map((one) => shortName(one, all));
  assert.deepEqual(names, ["person (1)", "person #3", "chair", "person (2)", "person new"]);
  assert.equal(shortName({ ...all[2], label: "person" }, all), "person", "while its class is being changed");
});
