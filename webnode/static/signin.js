// Sign in and out: by the code that the node printed, which a link may contain, or by the password.
import { element, words } from "./element.js";
import { base, get, leave, signed } from "./link.js";
import { panel } from "./panel.js";
import { forget, keep, token } from "./session.js";

const PAUSE = 3000;
let checking = false;
let told = () => {};

// The code of a link is used once and removed from the address, so that no bookmark or screenshot contains it.  The part
// behind it is the view to show.
function codeOfLink() {
  const [, code, view] = /^#code=([^/]+)(?:\/(.+))?$/.exec(location.hash) ?? [];
  if (code) history.replaceState(null, "", location.pathname + location.search);
  if (view) location.hash = view;
  return code ? decodeURIComponent(code) : "";
}

const signIn = (code) => signed("POST", { code });

// Resolve when the visitor is signed in; `onMe` gets { name, role } at each sign-in.
export async function enter(onMe) {
  told = onMe;
  const code = codeOfLink();
  let trouble = "";
  if (code) await signIn(code).catch((error) => { trouble = error.message; });
  await check(trouble);
}

async function check(trouble = "") {
  checking = true;
  let me = await get("session").catch(() => null);
  while (!me || me.role === "anyone") {
    if (me) {
      if (token(base())) keep(base(), undefined);
      const { asked } = await import("./door.js");
      await asked(trouble, signIn);
    } else await new Promise((done) => setTimeout(done, 1000));
    trouble = "";
    me = await get("session").catch(() => null);
  }
  checking = false;
  told(me);
}

panel({
  place: "more",
  order: 90,
  title: "Session",
  needs: { role: "viewer" },
  make(root, { model }) {
    const who = element("p", { class: "hint" });
    const out = element("button", {}, "Sign out");
    const more = element("button", { class: "operators" }, "Invite …");
    const trouble = element("p", { role: "status" });
    out.onclick = async () => {
      await leave();
      forget();
      location.reload();
    };
    // The dialog is loaded on demand.
    more.onclick = () => {
      words(trouble, "");
      import("./invite.js").then(({ open }) => open(model)).catch((error) => words(trouble, error.message));
    };
    let link = "wait";
    // A stream may have ended because the session did.
    const timer = setInterval(() => { if (link === "lost" && !checking) check(); }, PAUSE);
    root.className = "session";
    root.append(who, element("div", { class: "row" }, more, out), trouble);
    return {
      update(model) {
        link = model.link;
        const { name, role } = model.me;
        words(who, `Signed in as ${name && name !== role ? `${name}, ${role}` : role}.`);
        out.hidden = !token(base());
      },
      close: () => clearInterval(timer),
    };
  },
});

panel({
  place: "more",
  order: 95,
  title: "Audit log",
  needs: { role: "operator" },
  load: () => import("./audit.js"),
});
