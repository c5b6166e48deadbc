/** The keys of Review. */

/**
 * @param {object} parts
 * @param {ReturnType<typeof import("./commands.js").createCommands>} parts.commands
 * @param {Opening} parts.opening
 * @param {ReturnType<typeof import("./tracks.js").createTracks>} parts.tracks
 * @param {ReturnType<typeof import("./sheet.js").createSheet>} parts.sheet
 * @param {ReturnType<typeof import("./scene.js").createScene>} parts.scene
 * @param {ReturnType<typeof import("./image_panel.js").createImagePanel>} parts.image
 * @param {ReturnType<typeof import("./ortho_views.js").createOrthoViews>} parts.ortho
 * @param {(mode: Api.Gizmo) => void} parts.setGizmo
 * @param {ReturnType<typeof import("../attributes.js").createAttributes>} parts.attributes
 */
export function bindings({ commands, opening, tracks, sheet, scene, image, ortho, setGizmo, attributes }) {
  // a key that is held down acts on one box only, not on the following ones
  /** @param {(key: string) => unknown} fn */
  const once = (fn) => (/** @type {KeyboardEvent} */ event, /** @type {string} */ key) => {
    if (!event.repeat) fn(key);
  };
  return {
    accept: once(() => commands.decide("accept")),
    "accept-all": once(() => commands.whenCalm(commands.acceptAll)),
    reject: once(() => commands.decide("reject")),
    delete: once(() => commands.decide("delete")),
    refit: once(commands.refit),
    flip: once(commands.flip),
    class: (/** @type {KeyboardEvent} */ _, /** @type {string} */ key) => commands.setClass(key),
    attribute: (/** @type {KeyboardEvent} */ _, /** @type {string} */ key) => attributes.press(key),
    cancel: commands.cancel,
    finalise: once(commands.finalise),
    "copy-previous": once(commands.copy),
    follow: once(() => commands.followOne("forward")),
    "follow-back": once(() => commands.followOne("backward")),
    "follow-all": once(() => commands.followAll("forward")),
    "follow-all-back": once(() => commands.followAll("backward")),
    "copy-next": once(() => commands.whenCalm(() => tracks.copyToNext())),
    carry: once(() => commands.whenCalm(() => tracks.carry())),
    interpolate: once(() => commands.whenCalm(() => tracks.interpolate())),
    "interpolate-refit": once(() => commands.whenCalm(() => tracks.interpolate(true))),
    sheet: once(() => commands.whenCalm(sheet.show)),
    "next-of-track": once(() => commands.whenCalm(() => tracks.step(1))),
    "previous-of-track": once(() => commands.whenCalm(() => tracks.step(-1))),
    "next-box": () => commands.stepBox(1),
    "previous-box": () => commands.stepBox(-1),
    "next-frame": () => opening.step("next"),
    "previous-frame": () => opening.step("previous"),
    "draw-box": once(commands.draw),
    "gizmo-translate": () => setGizmo("translate"),
    "gizmo-rotate": () => setGizmo("rotate"),
    "gizmo-off": () => setGizmo("off"),
    "points-larger": () => scene.points(1.25),
    "points-smaller": () => scene.points(0.8),
    fit: () => {
      image.fit();
      ortho.fit();
    },
  };
}
