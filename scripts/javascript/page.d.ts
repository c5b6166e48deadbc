// Types that several modules of the page share. The server's JSON is in the namespace Api: see server_types.py.

// -- geometry. px are continuous and the centre of the first pixel is (0, 0); metres are in the camera frame.

/** [x, y] */
type Point = number[];
/** [x, y, z] */
type Vector = number[];
/** Three rows of three. */
type Matrix = number[][];
type Line = Point[];
type Size = { width: number; height: number };
type Rect = { x_min: number; y_min: number; x_max: number; y_max: number };
type Box2D = Rect & { label: string; score?: number };
/** The columns of `rotation` are the box's x (length), y (width) and z (height) axes. */
type Box3D = { center: number[]; size: number[]; rotation: number[][] };
/** A point p is at px x = (axes[0].p - origin_m[0]) / metres_per_px; y likewise with axes[1]. */
type Plane = Pick<Api.ViewJson, "axes" | "metres_per_px" | "origin_m">;
type Camera = Api.CameraJson & Size;
/** In degrees in forms, in radians elsewhere. */
type Angles = { yaw: number; pitch: number; roll: number };

// -- elements

type AttributeValue = string | number | boolean | null | undefined | ((event: never) => unknown);
type Listeners = { [K in keyof HTMLElementEventMap as `on${K}`]?: (event: HTMLElementEventMap[K]) => unknown };
interface Attributes extends Listeners {
  [name: string]: AttributeValue;
}
type Child = Node | string | null | undefined | false;
/** Children in lists, and in lists of lists. */
type Children = Child | Children[];
/** The tag of an element that is written with its classes: "div.row" is a "div". */
type TagOf<T extends string, Known> = (T extends `${infer Tag}.${string}` ? Tag : T) & keyof Known;

// -- what all modes share

type FrameState = Api.FrameStateJson;
/** An attribute as in project.json; what has its default is left out. */
type Attribute = {
  name: string;
  kind: "choice" | "boolean" | "integer" | "number" | "text";
  of?: "box" | "track" | "frame";
  choices?: string[];
  minimum?: number;
  maximum?: number;
  classes?: string[];
  required?: boolean;
  default?: string | number | boolean;
  key?: string;
};
/** A label as far as its attributes are concerned. */
type AttributeOwner = Pick<Api.LabelJson, "uid" | "label" | "attributes"> & { isNew?: boolean };
/** Sends one change of the classes; the fields are those of `annotator.project.classes.edit`. */
type ChangeClasses = (
  body:
    | Api.AddClass
    | Api.StyleClass
    | Api.Reorder
    | Api.RenameClass
    | Api.MergeClasses
    | Api.RemoveClass
    | Api.PutAttribute
    | Api.RenameAttribute
    | Api.RemoveAttribute,
) => Promise<unknown>;
type Route = { project: string | null; mode: string; frame: number | null; query: URLSearchParams };
type Direction = "next" | "previous";

/** Places (indices of frames) that the timeline shows. */
type Stretch = { first: number; count: number };
type Lane = Api.Lane;
/** First and last place, class, and 0 if its boxes are reviewed, else the level 1 to 5 of their doubt. */
type Span = Lane["spans"][number];
/** The frames and tracks of a recording; `places`: the place of each frame by its id. */
type Timeline = Api.LanesJson & { places: Map<number, number>; picture: (frame: number) => string };

interface StateValues {
  operator: string | null;
  version: string;
  route: Route;
  project: Api.ProjectInfo | null;
  /** The open frame. */
  frame: FrameState | null;
  /** Of the open frame's recording, once it is read. */
  timeline: Timeline | null;
  /** The track of the selected box, as the mode says. */
  track: number | null;
  /** The part of a track that is selected on the timeline: the ids of its first and last frame. */
  span: { trackId: number; from: number; to: number } | null;
  /** Frame id -> names of the operators who have it open. */
  presence: Record<string, string[]>;
  /** The newest first. */
  jobs: Api.Job[];
  connected: boolean;
}

interface StateMethods {
  set(changes: Partial<StateValues>): void;
  on<K extends keyof StateValues>(name: K, fn: (value: StateValues[K]) => unknown, until?: AbortSignal): () => void;
}

type State = StateValues & StateMethods;

/** The messages of the server and of the socket itself, by type. */
interface Messages {
  frame: { frame: number; revision: number };
  presence: { frames: Record<string, string[]> };
  job: { job: Api.Job };
  follow: { run: Api.FollowRunJson };
  /** A recording has another up direction or calibration. */
  adjusted: { recording: number; adjusted: number; operator: string };
  /** Frames show other objects that stand still, or show them elsewhere. */
  still: object;
  /** The classes or attributes have changed; `renamed`: old name of a class -> new name. */
  classes: { renamed: Record<string, string>; operator: string };
  replaced: { project: string };
  renamed: { name: string; operator: string };
  removed: { operator: string };
  /** A recording was removed from the project, or has come back. */
  recordings: { recording: number; operator: string };
  viewport: ViewportMessage;
  /** Whether the socket is open. */
  connection: boolean;
  /** Messages may have been missed. */
  reconnected: null;
}

type ViewportMessage = { workbench: string } & (
  | { event: "connected"; connected: boolean }
  | { event: "select"; uid: string }
  | ({ event: "box" } & MovedBox)
);

/** What a mode does with the 3D view. */
interface ViewportUser {
  onSelect(uid: string): void;
  /** The gizmo moves a box; the last message of a drag is `final`. */
  onBox(moved: MovedBox): void;
}
type MovedBox = { uid: string; box: Box3D; final: boolean };

/** What the colours of boxes in the 3D view say. */
type BoxColor = "state" | "class" | "track";
type ViewportState = "opening" | "ready" | "lost" | "unsupported";

type Word<W> = W extends string ? (string extends W ? "*" : W) : "*";
/** The words of a path, with a star for each value. */
type Words<P extends readonly unknown[]> = P extends readonly [infer W]
  ? Word<W>
  : P extends readonly [infer W, ...infer Rest]
    ? `${Word<W>}/${Words<Rest>}`
    : "";
/** The path of a project's resource; `of` is there only for the type of the answer. */
type ProjectPath<P extends readonly unknown[]> = string & { readonly of: Words<P> };
type Asked<
  Method extends string,
  P,
> = `${Method} ${P extends { readonly of: infer Of extends string } ? Of : P & string}`;
/** What the server's schema says of the answer to a request; unknown for a path that is made of text. */
type Answer<Method extends string, P> =
  Asked<Method, P> extends infer Known extends keyof Api.Answers ? Api.Answers[Known] : unknown;
type Ask<Method extends string> = <P extends string, T = Answer<Method, P>>(
  path: P,
  options?: RequestOptions,
) => Promise<T>;
type Send<Method extends string> = <P extends string, T = Answer<Method, P>>(
  path: P,
  body?: object,
  options?: RequestOptions,
) => Promise<T>;

type Client = ReturnType<typeof import("../../web_assets/js/api.js").createApi>;
type RequestOptions = { signal?: AbortSignal };
type EffortCounter = ReturnType<typeof import("../../web_assets/js/effort.js").createEffort>;
type Events = ReturnType<typeof import("../../web_assets/js/events.js").createEvents>;
type Keys = ReturnType<typeof import("../../web_assets/js/keys.js").createKeys>;
/** `key`: its name as in the table; "" for a button. */
type KeyHandler = (key: string) => unknown;
/** A row of the table of keys: `shown` is what the table shows in place of `keys`. */
type KeyRow = { id: string; keys: string[]; shown?: string[]; label: string; group: string };
/** A row of a chooser: `frame` is the one to go to, `done` the share of its boxes that are reviewed. */
type Choice = { name: string; frame: number | null; isCurrent: boolean; note: string; done?: number | null };
type Frames = ReturnType<typeof import("../../web_assets/js/frame_state.js").createFrameState>;
type Viewport = ReturnType<typeof import("../../web_assets/js/viewport.js").createViewport>;
type ViewportBar = ReturnType<typeof import("../../web_assets/js/viewport_bar.js").createViewportBar>;

/** The object that each mode receives; js/main.js creates it. */
interface App {
  api: Client;
  effort: EffortCounter;
  events: Events;
  frames: Frames;
  keys: Keys;
  state: State;
  viewport: Viewport | null;
  toast: typeof import("../../web_assets/js/messages.js").toast;
  /** Goes to an address from router.makeHash. */
  go(hash: string): void;
  /** The path of a resource of the open project: app.path("frames", 3). */
  path<const P extends readonly (string | number)[]>(...parts: P): ProjectPath<P>;
  /** Reads the project's summary again, into state.project. */
  refreshProject(): Promise<void>;
  /** Reads a frame into state.frame, and reports to the other pages that it is open here. */
  loadFrame(id: number, bestFor?: string | null): Promise<FrameState>;
  /** Saves everything that a frame does not keep. False if something cannot be saved and the operator stays with it. */
  mayLeave(to?: number | null): Promise<boolean>;
  /** Sets the address back to the frame that is shown. */
  stay(frame: number): void;
  undo(): Promise<void>;
  redo(): Promise<void>;
}

/** The same with an open project, as in all modes except the start page. */
interface ModeApp extends App {
  state: State & { project: Api.ProjectInfo; route: Route & { project: string } };
  viewport: Viewport;
}

/** Unsaved work, which would be lost. `retry` saves it; `action` names that, by default "Try again". */
type Unsaved = { text: string; retry: () => unknown; action?: string; discard: () => void };

/** A mounted mode. */
interface Mounted {
  unmount?(): void;
  /** Called instead of a new mount if only the frame or the query of the address has changed. */
  route?(route: Route): void;
  /** Resolves when all changes that are being saved are saved, or have failed. */
  flush?(): Promise<unknown>;
  /** `to`: the frame that is opened next; null: none. */
  unsaved?(to: number | null): Unsaved | null;
}

type ErrorBody = {
  error?: Api.ErrorBody;
  state?: FrameState;
  frame?: number;
  track?: number;
  moved?: Api.MissingRecording;
};
type StaleError = Error & { body: { state: FrameState } };
type TrackTakenError = Error & { body: { track: number } };

interface Mode {
  /** `until`: aborted when another mode is mounted. */
  mount(root: HTMLElement, app: ModeApp, until: AbortSignal): Mounted | void;
}

/** A version of a frame that could not be saved: lines of text, and the boxes drawn over the other version. */
type Mine = { text: string[]; boxes: Rect[]; outlines: Line[][] };

// -- the 2D editor

/** `suggested` is dashed until the operator accepts it; `caption` replaces the label. */
type EditorBox = Box2D & {
  suggested?: boolean;
  faint?: boolean;
  caption?: string;
};

/** An arrow in px of a picture; `sight`: cosine of the angle between it and the line of sight. */
type Arrow = { from: Point; to: Point; sight: number };

/** Lines over the picture. One with an `id` can be clicked; `tag` is a short text at its top corner; `wrong`: its heading. */
type Overlay = {
  id?: string;
  segments: Line[];
  heading?: Arrow | null;
  color: string;
  dash?: boolean;
  strong?: boolean;
  tag?: string;
  wrong?: boolean;
};

type EditKind = "draw" | "move" | "resize" | "nudge" | "delete" | "accept";
type View = ReturnType<typeof import("../../web_assets/js/editor2d/geometry.js").createView>;

interface EditorOptions {
  /** Accessible name. */
  label: string;
  /** Ends the editor. */
  until: AbortSignal;
  color: (box: EditorBox) => string;
  /** Class of a drawn box. */
  newLabel?: () => string | null;
  /** Only the selected box can be resized: a drag that begins on the edge of another box draws a new one. */
  selectFirst?: boolean;
  /** There is only one box; drawing replaces it. */
  single?: boolean;
  /** Whether a drag draws a box; by default it does. */
  canDraw?: () => boolean;
  /** Whether a box was asked for: if not, a drag draws one all the same, but no lines show where. */
  isAsked?: () => boolean;
  /** A drag with a shorter side draws no box, CSS pixels; 0 by default. */
  leastDraw?: number;
  /** Boxes end at the picture's border; true by default. */
  clip?: boolean;
  /** Called after each finished change; `actions` is the number of key presses or drags. */
  onChange?: (boxes: EditorBox[], why: EditKind, index: number, actions: number) => unknown;
  /** Called while dragging, before the change is finished. */
  onDrag?: (boxes: EditorBox[], index: number) => unknown;
  /** Called with the index of the selected box; -1: none. */
  onSelect?: (index: number) => unknown;
  /** Called when a drag has ended, also without a change, and after `onChange`. */
  onEnd?: () => unknown;
  /**
   * Called while a handle is pulled; without it there is none. "turn": radians, positive from x towards y; "slide":
   * metres along `sight`. The editor draws the box so until setBoxes.
   */
  onPull?: (handle: PullHandle, by: number, isFinal: boolean) => unknown;
  /** Called by a click within the outline of an overlay with an id, but in no box. */
  onOverlay?: (id: string) => unknown;
}

type PullHandle = "turn" | "slide";

interface Editor {
  readonly root: HTMLElement;
  /** window = offset + (px + 0.5) * scale, CSS pixels of `root`. */
  readonly view: View;
  /** Of the window, CSS pixels; `border` is its outer width. */
  readonly size: Size & { border: number };
  readonly options: EditorOptions;
  /** Changed only as a whole. */
  boxes: EditorBox[];
  selected: number;
  overlays: Overlay[];
  /** The line of sight, px of the picture for each metre, along which a handle moves the box. */
  sight: Point | null;
  isReadonly: boolean;
  /** Where the pointer is, in the window. */
  cross: Point | null;
  /** How far a handle of the selected box is pulled. */
  pulled: { handle: PullHandle; by: number } | null;

  // for its gestures
  redraw(): void;
  canDraw(): boolean;
  limits(): Rect;
  setCross(point: Point | null, px?: Point): void;
  /** Shows boxes as a drag makes them. */
  show(boxes: EditorBox[], selected: number): void;
  /** Shows a box as a drag makes it. */
  put(index: number, box: EditorBox): void;
  commit(why: EditKind, index: number, actions?: number): void;
  pull(handle: PullHandle, by: number, isFinal: boolean): void;
  select(index: number): void;

  /**
   * Shows a picture of width x height px, or none (null). The previous picture stays until the new one is decoded, and
   * the zoom stays if the size does. Resolves when it is on the screen; to false if a later call has replaced it.
   */
  setPicture(url: string | null, width?: number, height?: number): Promise<boolean>;
  /** New boxes; a drag in progress is cancelled. */
  setBoxes(list: EditorBox[], index?: number): void;
  setOverlays(overlays: Overlay[], sight?: Point | null): void;
  setReadonly(value: boolean): void;
  fit(): void;
  deleteSelected(): void;
  /** Cancels the drag; false if there is none. */
  cancel(): boolean;
  /** Several presses of arrow keys in quick succession count as one change: ends it. */
  flush(): void;
  /** True during a drag, and while key presses are collected into one change; setBoxes must not be called then. */
  readonly isDragging: boolean;
}

/** What listens to pointers: an editor, or a map. px are of what `view` calls the picture. */
interface PointerHost {
  root: HTMLElement;
  size: Size & { border?: number };
  view: Pick<View, "toPicture" | "panBy" | "zoomAbout">;
  until: AbortSignal;
  redraw(): void;
  hit(px: Point, event: PointerEvent): Hit;
  begin(hit: Hit, px: Point, point: Point): Gesture;
  onEnd?(): unknown;
  flush?(): void;
  setCross?(point: Point | null, px?: Point): void;
  isAsked?(): boolean;
}

/** The thing under a pointer; the sides are -1, 0 or 1. */
type Hit = {
  kind: PullHandle | "resize" | "move" | "draw" | "nothing";
  index: number;
  sideX?: number;
  sideY?: number;
};

/** What a drag does; `cancel` only if it must restore something other than the boxes. */
type Drag = { move: (px: Point, point: Point) => void; finish: () => void; cancel?: () => void };

/** The place of a text at an overlay. */
type Tag = { x: number; y: number; width: number };

/** From pointer down to pointer up; px are of the picture, the point is in the window. */
type Gesture = {
  move: (px: Point, point: Point) => void;
  finish: (px: Point, point: Point) => void;
  cancel: () => void;
};

// -- Annotate: what is drawn on the pseudo-views

type ViewBox = Box2D | null;

/**
 * An object of a frame: its box on the image, and up to four boxes on its views (front and side of step 1, then of
 * step 2). `stored` is the image box that was last sent to the server, or null.
 */
type Item = {
  image_box: Box2D;
  uid: string | null;
  boxes: ViewBox[];
  views: (Api.ViewJson | null)[];
  /** The detectors whose boxes were accepted. */
  suggested: (Api.Suggestion | null)[];
  stored: Box2D | null;
  /** The new box that was found in its image box, while nothing is drawn for it. */
  found: string | null;
};

/** The object that is being drawn. `changes` counts the operator's changes. */
type Draft = {
  item: Item;
  /** Its frame's id. */
  frame: number;
  /** Its views with suggestions, as the server answered last. */
  answer: Omit<Api.StepsOut, "box" | "points">;
  isLoading: boolean;
  changes: number;
  /** Whole boxes that are offered for the object as it was after so many changes, which one is shown, since when. */
  whole: { boxes: Api.WholeBoxJson[]; shown: number; changes: number; since: number } | null;
};

/** What the files about the pseudo-views share. */
interface Work {
  app: ModeApp;
  until: AbortSignal;
  saver: Saver;
  whole: WholeBoxes;
  objects: ReturnType<typeof import("../../web_assets/js/annotate/objects.js").createObjects>;
  /** Shows everything anew. */
  show(): void;
  /** Says why a detector suggests nothing. */
  report(role: Api.DetectorKind, problem: string | null): void;
  setKind(kind: Api.BoxKind): void;
  /** To be called when an object is about to be stored. */
  onStored(item: Item): void;
  items: Item[];
  /** The current object. */
  draft: Draft | null;
  /** The object that is selected on the image. */
  selected: Item | null;
  /** Objects that were replaced by another operator's version, but are still shown. */
  notSaved: Item[];
  /** The boxes that the image detector found. */
  detections: Box2D[];
  readonly isReadonly: boolean;
  /** What the boxes enclose. */
  readonly kind: Api.BoxKind;
}

/** A change of a frame. Its body is made when it is sent, from the frame's state at that time. */
type FrameChange<T = any> = {
  path: string[];
  body: (state: FrameState) => object;
  /** The frame's state in the answer, which is that state by default; null: it has none. */
  stateOf?: (answer: T) => FrameState | null;
  /** The operator's version, for the question in stale.js; without it, nobody is asked. */
  mine?: (state: FrameState) => Mine;
  /** It is sent once more if others have changed the frame: it changes nothing of theirs. */
  isSentAgain?: boolean;
  /** The older revision on which it is based, if others have changed the same since. */
  base?: () => number | undefined;
  /** The change that is sent in its place if its track is taken; null: none. */
  instead?: (error: TrackTakenError, state: FrameState) => Promise<FrameChange<T> | null>;
  done?: (answer: T) => void;
  item?: Item;
  /** Gives its boxes the new names of classes. */
  relabel?: (named: Naming) => void;
};

/** Gives a box another class. */
type Naming = <T extends ViewBox | undefined>(box: T) => T;

type Waiting = FrameChange & { frame: number };

type Saver = ReturnType<typeof import("../../web_assets/js/annotate/saver.js").createSaver>;
type WholeBoxes = ReturnType<typeof import("../../web_assets/js/annotate/suggestions.js").createWholeBoxes>;
type Teach = ReturnType<typeof import("../../web_assets/js/annotate/teach.js").createTeach>;

/** The parts of Annotate, which use each other once all are there; js/annotate/annotate.js makes them. */
interface Annotate {
  app: ModeApp;
  /** Ends the mode. */
  until: AbortSignal;
  /** The elements of its panels. */
  parts: ReturnType<typeof import("../../web_assets/js/annotate/annotate.js").layout>;
  desk: Desk;
  queue: Queue;
  opening: Opening;
  preload: ReturnType<typeof import("../../web_assets/js/annotate/preload.js").createPreload>;
  areas: ReturnType<typeof import("../../web_assets/js/annotate/areas.js").createAreas>;
  picker: ReturnType<typeof import("../../web_assets/js/classes/picker.js").createNextClass>;
  sheet: ReturnType<typeof import("../../web_assets/js/annotate/sheet.js").createSheet>;
  tracks: ReturnType<typeof import("../../web_assets/js/annotate/tracks.js").createTracks>;
  follow: ReturnType<typeof import("../../web_assets/js/annotate/follow.js").createFollow>;
  image: ReturnType<typeof import("../../web_assets/js/annotate/image_panel.js").createImagePanel>;
  scene: ReturnType<typeof import("../../web_assets/js/annotate/scene.js").createScene>;
  map: ReturnType<typeof import("../../web_assets/js/annotate/map.js").createMap>;
  ortho: ReturnType<typeof import("../../web_assets/js/annotate/ortho_views.js").createOrthoViews>;
  teach: Teach;
  attributes: ReturnType<typeof import("../../web_assets/js/attributes.js").createAttributes>;
  commands: ReturnType<typeof import("../../web_assets/js/annotate/commands.js").createCommands>;
  actions: ReturnType<typeof import("../../web_assets/js/annotate/actions.js").createActions>;
  /** Shows what is being drawn on the pseudo-views in all parts. */
  showDrawn(): void;
  /** Goes to the camera that sees a box of the moment best. */
  showBest(uid: string): void;
}

// -- Annotate: boxes

/** A label as the page shows it: stored, or new (`isNew`), which is not stored until it is accepted. */
type PageLabel = Omit<Api.LabelJson, "source" | "author" | "box"> & {
  box: Box3D;
  source: string;
  author: string | null;
  isNew?: boolean;
};

/** The values of a label that an operator may change. */
type Wanted = { label: string; track_id: number | null; box: Box3D };

type Desk = ReturnType<typeof import("../../web_assets/js/annotate/desk.js").createDesk>;
type Opening = ReturnType<typeof import("../../web_assets/js/annotate/opening.js").createOpening>;
type DeskEvent = "frame" | "selection" | "draft" | "saving";
/** One of `Api.ChangesIn`. */
type Change = {
  kind: Exclude<Api.ChangesIn["changes"][number]["kind"], "image_boxes">;
  uid?: string;
  label?: string;
  box?: Box3D;
  track_id?: number | null;
  box_kind?: Api.BoxKind | null;
  here?: boolean;
  image_box?: (Rect & { label: string }) | null;
  suggestion?: Api.Suggestion | null;
};
/**
 * A label that the operator is changing: `base` is what is changed, as it was stored in the frame's `revision`; `sending`
 * are the values being sent, `sent` is whether that succeeds.
 */
type LabelDraft = {
  /** Of an object that stands still: only in this frame. */
  here: boolean;
  wanted: Wanted;
  base: Wanted & { uid: string };
  revision: number;
  sending: Wanted | null;
  sent: Promise<boolean>;
  problem: string | null;
};
/** A label that is not stored yet; `actions` is its effort. */
type NewLabel = {
  label: PageLabel;
  /** The box on the image in which it was found; null: it was placed in the top view. */
  image_box: (Rect & { label: string }) | null;
  /** The frame on whose image that is. */
  frame: number | null;
  /** The box that the detector found. */
  found: Box3D;
  actions: number;
  problem: string | null;
  sending: Promise<boolean> | null;
};
type QueueItem = Api.ItemJson;
/** What is asked of the values of an attribute, as the server's query has it. */
type ValueQuery = Partial<Record<"attribute" | "value" | "contains" | "low" | "high" | "known", string>>;
type Queue = ReturnType<typeof import("../../web_assets/js/annotate/queue.js").createQueue>;
/** A box of a frame, or without a uid the frame itself. */
type Target = { frame: number; uid: string | null };

// -- charts

type Layout = { xaxis?: object; yaxis?: object; [name: string]: unknown };
type Chart = { traces: object[]; layout: Layout };
/** The theme's colours by name. */
type Colors = Record<string, string>;
/** The part of the library that js/charts.js uses. */
type Plotly = {
  react(host: HTMLElement, traces: object[], layout: Layout, config: object): Promise<unknown>;
  purge(host: HTMLElement): void;
};
interface Window {
  Plotly?: Plotly;
}

// -- the 3D view

/** A box that is not stored. */
type PreviewBox = { uid: string; box: Box3D };
/** `Api.SceneRequest`, with boxes as the page has them. */
type Scene3D = Omit<Api.SceneRequest, "previews" | "draft" | keyof ViewportBar["settings"]> & {
  previews?: PreviewBox[];
  draft?:
    | (ReturnType<typeof import("../../web_assets/js/annotate/draft.js").drawnObject> & { box_kind: Api.BoxKind })
    | null;
};

// -- other modes

/** The result of an export job. */
type ExportResult = {
  format?: string;
  bytes?: number;
  splits?: Record<string, number>;
  /** What the format cannot store. */
  lost?: string[];
  unreadable?: string[];
  notes?: string[];
};
/** The result of an import: of recordings, and the number of boxes of classes that the project does not have. */
type ImportResult = { recordings?: number[]; unknown: Record<string, number> };
/** The button beside a recording; its test id ends with the folder's name. */
type Picker = {
  text: string;
  testid: string;
  onPick: (entry: Api.FolderEntry, button: HTMLButtonElement) => unknown;
};
