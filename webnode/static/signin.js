// Sign in and out: by the code that the node printed, which a link may contain, or by the password.
import { createElement, setText } from "./element.js";
import { currentOrigin, endSession, get, openSession } from "./connection.js";
import { registerPanel } from "./panel.js";
import { clearSessions, getToken, storeSession } from "./session.js";
import { text, textOf } from "./texts.js";

const PAUSE = 3000;
let isChecking = false;
let onSignedIn = () => {};

// The code of a link is used once and removed from the address, so that no bookmark or screenshot contains it.  The part
// after the code is the view to show.
function takeCodeOfLink() {
  const [, code, view] = /^#code=([^/]+)(?:\/(.+))?$/.exec(location.hash) ?? [];
  if (code) history.replaceState(null, "", location.pathname + location.search);
  if (view) location.hash = view;
  return code ? decodeURIComponent(code) : "";
}

const signIn = (code) => openSession("POST", { code });

// Resolve when the visitor is signed in; `onMe` gets { name, role } at each sign-in.
export async function signInVisitor(onMe) {
  onSignedIn = onMe;
  const code = takeCodeOfLink();
  let trouble = "";
  if (code) await signIn(code).catch((error) => { trouble = error.message; });
  await ensureSession(trouble);
}

async function ensureSession(trouble = "") {
  isChecking = true;
  let me = await get("session").catch(() => null);
  while (!me || me.role === "anyone") {
    if (me) {
      if (getToken(currentOrigin())) storeSession(currentOrigin(), undefined);
      const { showSignInDialog } = await import("./signin-dialog.js");
      await showSignInDialog(trouble, signIn);
    } else await new Promise((done) => setTimeout(done, 1000));
    trouble = "";
    me = await get("session").catch(() => null);
  }
  isChecking = false;
  onSignedIn(me);
}

registerPanel({
  place: "more",
  order: 90,
  needs: { role: "viewer" },
  make(root, { model }) {
    const who = createElement("p", { class: "hint" });
    const out = createElement("button", {}, text("session.sign_out"));
    const more = createElement("button", { class: "operators" }, text("session.invite"));
    const trouble = createElement("p", { role: "status" });
    out.onclick = async () => {
      await endSession();
      clearSessions();
      location.reload();
    };
    // The dialog is loaded on demand.
    more.onclick = () => {
      setText(trouble, "");
      import("./invite.js").then(({ openInvitation }) => openInvitation(model)).catch((error) => setText(trouble, error.message));
    };
    let link = "wait";
    // A stream may have ended because the session did.
    const timer = setInterval(() => { if (link === "lost" && !isChecking) ensureSession(); }, PAUSE);
    root.className = "session";
    root.append(who, createElement("div", { class: "row" }, more, out), trouble);
    return {
      update(model) {
        link = model.link;
        const { name, role } = model.me;
        setText(who, text(name && name !== role ? "session.signed_in" : "session.signed_in_role", { name, role: textOf("role", role) }));
        out.hidden = !getToken(currentOrigin());
      },
      close: () => clearInterval(timer),
    };
  },
});

registerPanel({
  place: "more",
  order: 95,
  needs: { role: "operator" },
  load: () => import("./audit.js"),
});
