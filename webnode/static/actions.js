// Actions of an operator that are not needed at the first sight of the page: each is loaded when it is wanted.
import { panel } from "./panel.js";

const operator = { role: "operator" };

panel({ place: "tasks", order: 10, title: "Who could take it", load: () => import("./preview.js") });
panel({ place: "map", order: 10, title: "Robots", needs: { ...operator, has: "yard" }, load: () => import("./yard.js") });
panel({ place: "device", order: 20, title: "Settings", load: () => import("./settings.js") });
