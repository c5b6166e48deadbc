// What pointers and keys do in the 2D editor: boxes are drawn, changed, accepted, turned; the picture is moved, zoomed.

import assert from "node:assert/strict";
import { mock, test } from "node:test";
import { fakeBrowser } from "./fakes.js";

const element = fakeBrowser();
const { createEditor } = await import("../../web_assets/js/editor2d/editor.js");
const { ROTATE_ARM } = await import("../../web_assets/js/editor2d/draw.js");

const [WIDTH, HEIGHT] = [320, 240];
const box = (left, top, right, bottom, more = {}) => {
  return { label: "person", x_min: left, y_min: top, x_max: right, y_max: bottom, ...more };
};
const edges = ({ x_min, y_min, x_max, y_max }) => [x_min, y_min, x_max, y_max];
const near = (a, b) =>
  assert.ok(
    a.every((value, i) => Math.abs(value - b[i]) < 1e-6),
    `${a} is not ${b}`,
  );

/** An editor with a picture; `log` has what it tells, `point` the window's position of a pixel. */
async function editorOf(options = {}) {
  const log = [];
  const editor = createEditor(element("div"), {
    until: new AbortController().signal,
    color: () => "#ffffff",
    newLabel: () => "person",
    onChange: (boxes, why, index, actions) => log.push({ why, index, actions, boxes }),
    onPull: (why, by, isFinal) => isFinal && log.push({ why, by }),
    onOverlay: (id) => log.push({ why: "overlay", id }),
    ...options,
  });
  await editor.setPicture("a.png", WIDTH, HEIGHT);
  const point = ([x, y]) => {
    const { scale, offset } = editor.view;
    return [offset[0] + (x + 0.5) * scale, offset[1] + (y + 0.5) * scale];
  };
  const send = (type, [clientX, clientY], more = {}) =>
    editor.root.dispatchEvent(
      Object.assign(new Event(type, { cancelable: true }), {
        ...{ clientX, clientY, pointerId: 1, pointerType: "mouse", button: 0, deltaMode: 0 },
        ...more,
      }),
    );
  const drag = (start, end, more) => {
    const [from, to] = [point(start), point(end)];
    send("pointermove", from, more);
    send("pointerdown", from, more);
    send("pointermove", [(from[0] + to[0]) / 2, (from[1] + to[1]) / 2 + 3], more);
    send("pointermove", to, more);
    send("pointerup", to, more);
  };
  const click = (px) => {
    for (const type of ["pointerdown", "pointerup"]) send(type, point(px));
  };
  const key = (name, more) => editor.root.dispatchEvent(Object.assign(new Event("keydown"), { key: name, ...more }));
  const set = (boxes, selected = 0) => editor.setBoxes(boxes, selected);
  const whys = () => log.splice(0).map(({ why }) => why);
  return { editor, log, point, send, drag, click, key, set, whys, edges: (index = 0) => edges(editor.boxes[index]) };
}

test("a drag stores its start and end at every zoom, and the pixel under the pointer stays", async () => {
  const it = await editorOf({ single: true });
  for (const wanted of [0.75, 4, 25]) {
    const before = it.point([150, 110]);
    it.send("pointermove", before);
    const isTooSmall = () => it.editor.view.scale < wanted;
    const [wasTooSmall, deltaY] = [isTooSmall(), isTooSmall() ? -120 : 120];
    for (let i = 0; i < 60 && isTooSmall() === wasTooSmall; i += 1) it.send("wheel", before, { deltaY });
    near(it.point([150, 110]), before);
    const reach = Math.min(60, 150 / it.editor.view.scale);
    const [start, end] = [
      [150 - reach, 110 - 0.7 * reach],
      [150 + 0.8 * reach + 0.3, 110 + reach],
    ];
    it.set([], -1);
    it.drag(start, end);
    near(it.edges(), [...start, ...end]);
    assert.deepEqual(it.whys(), ["draw"]);
  }
});

test("a box is resized at its edge, moved inside, put back when it is cancelled, selected by a click and deleted", async () => {
  const it = await editorOf();
  for (const [grab, drop, wanted, why] of [
    [[50, 90], [42, 97], [42, 60, 150, 120], "resize"],
    [[100, 90], [112, 75], [62, 45, 162, 105], "move"],
  ]) {
    it.set([box(50, 60, 150, 120)]);
    it.drag(grab, drop);
    near(it.edges(), wanted);
    assert.deepEqual(it.whys(), [why]);
  }
  it.set([box(50, 60, 150, 120)]);
  it.send("pointerdown", it.point([100, 90]));
  it.send("pointermove", it.point([140, 130]));
  near(it.edges(), [90, 100, 190, 160]);
  it.editor.cancel();
  it.send("pointerup", it.point([10, 10]));
  assert.deepEqual([it.edges(), it.whys()], [[50, 60, 150, 120], []]);
  it.set([box(20, 20, 80, 90), box(120, 30, 200, 160)], 1);
  it.click([50, 60]);
  assert.equal(it.editor.selected, 0);
  it.editor.deleteSelected();
  assert.deepEqual([it.edges(), it.whys()], [[120, 30, 200, 160], ["delete"]]);
});

test("the middle button and Space pan, and a click on an outline tells its id", async () => {
  const it = await editorOf();
  const space = (type) => window.dispatchEvent(Object.assign(new Event(type), { key: " " }));
  const before = it.point([100, 100]);
  it.drag([100, 100], [130, 120], { button: 1 });
  near(it.point([70, 80]), before);
  space("keydown");
  it.drag([70, 80], [100, 100]);
  space("keyup");
  near(it.point([40, 60]), before);
  const outline = [
    [40, 40],
    [120, 40],
    [120, 100],
    [40, 100],
  ].map((corner, i, all) => [corner, all[(i + 1) % 4]]);
  it.editor.setOverlays([{ segments: outline, color: "lime", id: "abc" }]);
  it.click([80, 70]);
  it.click([200, 200]);
  assert.deepEqual(it.log, [{ why: "overlay", id: "abc" }]);
});

test("arrow keys move edges by whole pixels, as one change", async () => {
  mock.timers.enable({ apis: ["setTimeout"] });
  const it = await editorOf();
  it.set([box(50.25, 60.5, 150.25, 120.5)]);
  it.key("ArrowRight");
  it.key("ArrowDown");
  it.key("ArrowLeft", { shiftKey: true });
  it.key("ArrowRight", { altKey: true });
  it.key("ArrowDown", { altKey: true, shiftKey: true });
  assert.deepEqual([it.log, it.editor.isDragging], [[], true]);
  mock.timers.tick(500);
  assert.deepEqual(it.edges(), [41.25, 61.5, 142.25, 131.5]);
  assert.deepEqual(
    it.log.map(({ why, actions }) => [why, actions]),
    [["nudge", 5]],
  );
  mock.timers.reset();
});

test("a suggestion is accepted by a click, corrected by a drag, and replaced by another box", async () => {
  const it = await editorOf({ single: true });
  const suggest = () => it.set([box(50, 60, 150, 120, { suggested: true })]);
  suggest();
  it.click([100, 90]);
  suggest();
  it.drag([150, 90], [160, 90]);
  assert.ok(it.log.every(({ boxes }) => boxes[0].suggested === false));
  assert.deepEqual(it.whys(), ["accept", "resize"]);
  it.drag([170, 100], [220, 180]);
  assert.equal(it.editor.boxes.length, 1);
  near(it.edges(), [170, 100, 220, 180]);
});

test("the rotation handle counts clockwise angles as positive", async () => {
  const it = await editorOf();
  it.set([box(110, 100, 210, 160)]);
  const up = ROTATE_ARM / it.editor.view.scale;
  it.drag([160, 100 - up], [220, 130]);
  assert.ok(Math.abs(it.log.at(-1).by - Math.PI / 2) < 0.01);
  assert.deepEqual(it.whys(), ["turn"]);
});

test("the handle on the line of sight counts metres along it, whatever the pointer does across it", async () => {
  const it = await editorOf();
  it.set([box(110, 100, 210, 160)]);
  const down = 20 / it.editor.view.scale;
  it.editor.setOverlays([], [0, 40]);
  it.drag([160, 160 + down], [175, 160 + down + 60]);
  near([it.log.at(-1).by], [1.5]);
  assert.deepEqual(it.whys(), ["slide"]);
});

test("one finger draws, and two fingers zoom", async () => {
  const it = await editorOf();
  const touch = (type, pointerId, at) => it.send(type, at, { pointerId, pointerType: "touch" });
  it.drag([40, 50], [180, 140], { pointerType: "touch" });
  near(it.edges(), [40, 50, 180, 140]);
  const { scale } = it.editor.view;
  const [[x, y], [u, v]] = [it.point([100, 120]), it.point([200, 120])];
  touch("pointerdown", 1, [x, y]);
  touch("pointerdown", 2, [u, v]);
  touch("pointermove", 1, [x - 100, y]);
  touch("pointermove", 2, [u + 100, v]);
  touch("pointerup", 1, [x - 100, y]);
  touch("pointerup", 2, [u + 100, v]);
  assert.ok(Math.abs(it.editor.view.scale / scale - (u - x + 200) / (u - x)) < 1e-6);
  near(it.edges(), [40, 50, 180, 140]);
  assert.deepEqual(it.whys(), ["draw"]);
});

test("what comes after an editor has ended is not drawn", async () => {
  let asked = 0;
  const color = () => {
    asked += 1;
    return "#ffffff";
  };
  const end = new AbortController();
  const { editor } = await editorOf({ color, until: end.signal });
  editor.setBoxes([{ label: "person", x_min: 10, y_min: 10, x_max: 50, y_max: 50 }]);
  await editor.setPicture("b.png", WIDTH, HEIGHT);
  assert.ok(asked > 0);
  end.abort();
  asked = 0;
  await editor.setPicture("c.png", WIDTH, HEIGHT);
  assert.equal(asked, 0);
});
