// The page's geometry: boxes in 3D, their orthogonal views, and the camera, against the package's own numbers.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import * as box3d from "../../web_assets/js/box3d.js";
import * as camera from "../../web_assets/js/camera.js";
import { aboutAxis, cross, dot, IDENTITY, multiply, subtract, transpose } from "../../web_assets/js/rotation.js";

const cases = JSON.parse(readFileSync(new URL("geometry.json", import.meta.url), "utf8"));
const boxes = cases.boxes.map(({ box }) => box);
const UP = [0.02, -0.96, -0.28];
const [PLAIN] = cases.cameras;

const flat = (value) => (Array.isArray(value) ? value.flatMap(flat) : [value]);

/** Whether numbers in arrays of the same shape agree. */
function assertClose(ours, wanted, tolerance = 1e-9) {
  const [a, b] = [flat(ours), flat(wanted)];
  assert.equal(a.length, b.length);
  a.forEach((value, i) => {
    assert.ok(Math.abs(value - b[i]) <= tolerance, `${value} is not ${b[i]} (number ${i})`);
  });
}

const difference = (a, b) => a.map((value, i) => value - b[i]);
/** A vector of the camera frame along the axes of a box. */
const along = (box, vector) => [0, 1, 2].map((i) => dot(box3d.boxAxis(box, i), vector));
const sumOfAxes = (rotation) => [0, 1, 2].map((i) => rotation[i][0]);

test("corners agree with the package", () => {
  for (const { box, corners } of cases.boxes) assertClose(box3d.corners(box), corners);
});

test("projection agrees with the package, with each kind of lens", () => {
  for (const { camera: data, points, px, extents } of cases.cameras) {
    assertClose(
      points.map((point) => camera.project(data, point)),
      px,
    );
    assert.equal(camera.project(data, [0.1, 0.1, -1]), null);
    extents.forEach((extent, i) => {
      const seen = camera.outline(data, boxes[i]).flat();
      const [xs, ys] = [0, 1].map((axis) => seen.map((point) => point[axis]));
      assertClose([Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)], extent, 0.5);
    });
  }
});

test("an outline is clipped to the image and the near plane", () => {
  const data = { fx: 500, fy: 500, cx: 320, cy: 240, distortion: [], width: 640, height: 480 };
  const lines = camera.outline(data, { center: [0, 0, 0.5], size: [0.2, 0.2, 4], rotation: IDENTITY });
  assert.ok(lines.length > 0);
  for (const [x, y] of lines.flat()) {
    assert.ok(x >= -0.5 - 1e-9 && x <= 639.5 + 1e-9 && y >= -0.5 - 1e-9 && y <= 479.5 + 1e-9, `${x}, ${y}`);
  }
  assert.deepEqual(camera.outline(data, { center: [0, 0, -3], size: [1, 1, 1], rotation: IDENTITY }), []);
});

// Of each of Review's views: how an edge pulled by 0.1 m to the right or down changes length, width and height, and
// how it shifts the centre along the box's axes, m.
const PULLS = [
  ["top", "x_max", [0, 0.1, 0], [0, -0.05, 0]], // the right edge is the right side
  ["top", "y_min", [-0.1, 0, 0], [-0.05, 0, 0]], // the upper edge is the front
  ["front", "x_max", [0, 0.1, 0], [0, 0.05, 0]], // the right edge is the left side: it faces you
  ["front", "x_min", [0, -0.1, 0], [0, 0.05, 0]],
  ["front", "y_max", [0, 0, 0.1], [0, 0, -0.05]],
  ["side", "x_max", [0.1, 0, 0], [0.05, 0, 0]], // the right edge is the front
  ["side", "x_min", [-0.1, 0, 0], [0.05, 0, 0]],
];

test("an edge of a view moves the one face that it shows", () => {
  for (const [name, edge, size, shift] of PULLS) {
    for (const { box, views } of cases.boxes) {
      const view = views[name];
      const rect = box3d.viewRect(view, box);
      rect[edge] += 0.1 / view.metres_per_px;
      const after = box3d.withViewRect(view, box, rect);
      assertClose(difference(after.size, box.size), size);
      assertClose(along(box, difference(after.center, box.center)), shift);
      assertClose(after.rotation, box.rotation);
    }
  }
});

test("moving the rectangle keeps the size, and an edge cannot cross the opposite one", () => {
  const [{ box, views }] = cases.boxes;
  const rect = box3d.viewRect(views.side, box);
  const step = 0.07 / views.side.metres_per_px;
  const moved = box3d.withViewRect(views.side, box, { ...rect, x_min: rect.x_min + step, x_max: rect.x_max + step });
  assertClose(moved.size, box.size);
  assertClose(along(box, difference(moved.center, box.center)), [0.07, 0, 0]);
  const crossed = box3d.withViewRect(views.side, box, { ...rect, x_max: rect.x_min - 5 });
  assert.ok(Math.min(...crossed.size) > 0);
});

test("the handle of a view turns the box clockwise on the screen, about its centre", () => {
  const angle = Math.PI / 18;
  for (const [name, axis, sign] of [
    ["top", 2, -1],
    ["front", 0, -1],
    ["side", 1, 1],
  ]) {
    for (const { box, views } of cases.boxes) {
      const after = box3d.turned(box, views[name].axes[2], angle);
      const turn = multiply(transpose(box.rotation), after.rotation);
      assertClose(turn, aboutAxis(IDENTITY[axis], sign * angle));
      assertClose([after.center, after.size], [box.center, box.size]);
    }
  }
});

test("the heading is up in the top view, comes nearer in the front view, and is right on the side view", () => {
  const [{ box, views }] = cases.boxes;
  for (const [name, direction, sight] of [
    ["top", [0, -1], 0],
    ["front", [0, 0], -1],
    ["side", [1, 0], 0],
  ]) {
    const arrow = box3d.viewHeading(views[name], box);
    const reach = (0.4 * box.size[0]) / views[name].metres_per_px;
    assertClose(difference(arrow.to, arrow.from), [direction[0] * reach, direction[1] * reach], 1e-6);
    assertClose(arrow.sight, sight);
  }
});

test("the heading on the image agrees with the package and ends at the border", () => {
  for (const { box, heading_px } of cases.boxes) {
    const arrow = camera.imageHeading(PLAIN.camera, box);
    const [middle, tip] = heading_px;
    assertClose(arrow.from, middle, 1e-6);
    const isInside = tip[0] >= -0.5 && tip[0] <= 639.5 && tip[1] >= -0.5 && tip[1] <= 479.5;
    if (isInside) assertClose(arrow.to, tip, 1e-6);
  }
  const right = { center: [2.4, 0, 4], size: [2, 1, 1e-9], rotation: IDENTITY };
  const arrow = camera.imageHeading(PLAIN.camera, right);
  assertClose(arrow.to, [639.5, 240.5], 1e-6);
  assertClose(arrow.sight, 2.4 / Math.hypot(2.4, 4));
  assert.equal(camera.imageHeading(PLAIN.camera, { ...right, center: [8, 0, 4] }), null);
});

test("a heading that has turned by more than 120 degrees from its neighbour's is a jump", () => {
  const [first, second] = boxes;
  const jump = (/** @type {Vector | null} */ other, quarters = 0) =>
    box3d.headingJump({ box: box3d.headingTurned(first, quarters), heading_beside: other });
  const after = (/** @type {number} */ deg) =>
    jump(box3d.boxAxis(box3d.turned(first, box3d.boxAxis(first, 2), (deg * Math.PI) / 180), 0));
  assert.equal(jump(null), null);
  assert.equal(after(119.9), null);
  assertClose(after(120.1) ?? 0, 120.1);
  // the angle between the headings of the first two boxes is the package's
  assert.equal(jump(box3d.boxAxis(second, 0)), null);
  assertClose(jump(box3d.boxAxis(second, 0), 2) ?? 0, 180 - (cases.turn_of_heading * 180) / Math.PI, 1e-6);
});

test("turning the heading by 90 degrees keeps the corners", () => {
  for (const box of boxes) {
    const after = box3d.headingTurned(box, 1);
    assert.ok(box3d.fillSame(box, after));
    assert.ok(!box3d.fillSame(box, { ...after, size: box.size }));
    const corners = box3d.corners(after);
    for (const corner of box3d.corners(box)) {
      assert.ok(corners.some((other) => Math.hypot(...subtract(corner, other)) < 1e-9));
    }
    assertClose(box3d.boxAxis(after, 0), box3d.boxAxis(box, 1));
    assert.ok(box3d.sameBox(box3d.headingTurned(after, 3), box));
    assert.deepEqual(box3d.headingTurned(box, 2).size, box.size);
  }
});

test("boxes are the same within a tolerance at their ends", () => {
  const box = { center: [0, 0, 3], size: [4, 1, 1], rotation: IDENTITY };
  assert.ok(box3d.sameBox(box, { ...box, center: [5e-7, 0, 3] }));
  assert.ok(!box3d.sameBox(box, { ...box, center: [2e-6, 0, 3] }));
  assert.ok(!box3d.sameBox(box, { ...box, rotation: aboutAxis([0, 0, 1], 1e-6) }));
});

test("angles are recovered, whatever is up", () => {
  for (const up of [null, UP, [0, 0, 1]]) {
    for (const box of boxes) {
      assertClose(box3d.withAnglesDeg(box, up, box3d.anglesDeg(box, up)).rotation, box.rotation);
    }
  }
});

test("yaw is about up, to the left, and zero away from the camera", () => {
  const start = { center: [0, 0, 4], size: [1, 1, 1], rotation: IDENTITY };
  const up = UP.map((value) => value / Math.hypot(...UP));
  const level = box3d.withAnglesDeg(start, UP, { yaw: 0, pitch: 0, roll: 0 });
  assertClose(box3d.boxAxis(level, 2), up);
  assert.ok(sumOfAxes(level.rotation)[2] > 0.9, "the length axis looks away from the camera");
  assertClose(box3d.boxAxis(level, 1), cross(up, box3d.boxAxis(level, 0)));
  const left = box3d.withAnglesDeg(start, UP, { yaw: 90, pitch: 0, roll: 0 });
  assertClose(box3d.boxAxis(left, 0), box3d.boxAxis(level, 1));
  const steep = box3d.anglesDeg(box3d.withAnglesDeg(start, UP, { yaw: 30, pitch: 90, roll: 0 }), UP);
  assertClose([steep.yaw, steep.pitch, steep.roll], [30, 90, 0], 1e-4);
});
