// Panels for operators that are not part of the first view; each is loaded when it is needed.
import { registerPanel } from "./panel.js";

const operator = { role: "operator" };

registerPanel({ place: "tasks", order: 10, load: () => import("./preview.js") });
registerPanel({ place: "map", order: 10, needs: { ...operator, has: "yard" }, load: () => import("./map-robots.js") });
registerPanel({ place: "device", order: 20, load: () => import("./settings.js") });
