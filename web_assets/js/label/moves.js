/**
 * Objects whose box on the image was moved. Their boxes on views are carried to the new views (carry.js) before anything of
 * them is saved: as pixels of the old views they would be read as pixels of the new ones, which lie elsewhere.
 */

/** @param {object} loader draft.js. */
export function createMoves(loader) {
  /**
   * item -> {draft, views, is_waiting}: `views` is what the newest load resolves to, null where it is to be asked for anew.
   * The draft is kept afterwards: it has as guesses what could not be carried.
   */
  const moves = new WeakMap();

  /** Asks for a draft's views, as the loader does. */
  function load(draft) {
    const views = loader.load(draft);
    const move = moves.get(draft.item);
    if (move) move.views = views;
    return views;
  }

  return {
    load,
    /** Whether an object's boxes do not lie on its views yet. */
    isWaiting: (item) => Boolean(moves.get(item)?.is_waiting),
    /** The draft of an object that was moved. */
    draftOf: (item) => moves.get(item)?.draft ?? null,
    /** What is saved of a draft's object waits for its views from now on. */
    start: (draft) => moves.set(draft.item, { draft, views: null, is_waiting: true }),

    /** The object goes, or another version of it was taken. */
    forget(item) {
      moves.delete(item);
      loader.stop(item);
    },

    /** Another object, or none, is the current one: one that was moved is brought to its views all the same. */
    leave(draft) {
      if (draft && !moves.get(draft.item)?.is_waiting) loader.stop(draft.item);
    },

    /**
     * Resolves to true once an object's boxes lie on its own views, to false where it is gone. Rejects where its views
     * cannot be had; called again it asks again.
     *
     * @param {(draft: object) => void} ask asks for the views with `load`.
     */
    async settle(item, ask) {
      for (let move = moves.get(item); move?.is_waiting && move === moves.get(item); ) {
        if (!move.views) ask(move.draft);
        const { views } = move;
        try {
          const is_newest = await views;
          if (move.views !== views) continue;
          move.is_waiting = !is_newest;
          if (is_newest) return true;
          move.views = null;
        } catch (error) {
          if (move.views !== views) continue;
          move.views = null;
          if (move === moves.get(item)) throw error;
        }
      }
      return false;
    },
  };
}
