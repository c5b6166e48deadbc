/**
 * The state of the open frame, and the one rule by which another state takes its place.
 *
 * Answers overtake each other: that to a save, to an undo, to a question because somebody else has saved. Each state carries
 * the frame's revision, which grows with every change; an older one never replaces a newer one. What others save is told by
 * events. One that comes while something of one's own is on its way is remembered, and looked at after that (`isBehind`).
 */

/** So many times a frame is read again that somebody changes while it is being read. */
const MOST_READS = 4;

export function createFrameState(app) {
  const { state } = app;
  /** Frame id -> the newest revision that events told of. */
  const heard = new Map();
  let has_missed = false;

  // ids are counted in each project, and the picture's address names the project, too
  const isSame = (a, b) => Boolean(a && b) && a.frame.id === b.frame.id && a.image.url === b.image.url;
  const isTold = (frame) => (heard.get(frame.frame.id) ?? -1) > frame.frame.revision;

  const frames = {
    /** True where others have saved, or may have saved, something newer than what is shown. */
    get isBehind() {
      return state.frame !== null && (has_missed || isTold(state.frame));
    },

    /** A state of the open frame; resolves to false where it is an older one, or another frame's, and is not taken. */
    take(frame) {
      if (!isSame(frame, state.frame) || frame.frame.revision < state.frame.frame.revision) return false;
      state.set({ frame });
      return true;
    },

    /** Reads a frame and opens it. */
    async open(id, options) {
      const read = () => app.api.get(app.path("frames", id), options);
      let frame = await read();
      for (let reads = 1; reads < MOST_READS && isTold(frame); reads += 1) frame = await read();
      has_missed = false;
      if (!frames.take(frame)) state.set({ frame: isSame(frame, state.frame) ? state.frame : frame });
      return state.frame;
    },

    /** Reads the open frame again where it is behind. It is not taken where `isWelcome()` says no by then; it stays behind. */
    async refresh(isWelcome = () => true) {
      if (!frames.isBehind) return;
      const had_missed = has_missed;
      has_missed = false;
      try {
        const frame = await app.api.get(app.path("frames", state.frame.frame.id));
        if (isWelcome()) frames.take(frame);
        else has_missed ||= had_missed;
      } catch (error) {
        has_missed ||= had_missed;
        throw error;
      }
    },

    /** An event: somebody, perhaps oneself, has saved. */
    hear({ frame, revision }) {
      heard.set(frame, Math.max(heard.get(frame) ?? -1, revision));
    },

    /** Events may have been missed. */
    miss() {
      has_missed = true;
    },

    /** No frame is open: another project, or one that cannot be read. */
    close(is_other_project = false) {
      if (is_other_project) heard.clear();
      has_missed = false;
      state.set({ frame: null });
    },
  };
  return frames;
}
