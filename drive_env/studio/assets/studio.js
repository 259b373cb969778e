// The page's life line: beats while it is awake, what it holds, and the quick stop. See drive_env/studio/presence.py.
(() => {
  "use strict";
  const BEAT = 100; // ms
  const studio = (window.studio = { page: "", held: 0 });
  let line = null;
  let holds = 0;
  let holder = null;

  function send(message) {
    if (line && line.readyState === WebSocket.OPEN) {
      line.send(JSON.stringify(message));
      return true;
    }
    return false;
  }

  function connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    line = new WebSocket(`${scheme}://${location.host}/studio/life?page=${encodeURIComponent(studio.page)}`);
    line.onopen = () => document.body.classList.remove("studio-lost");
    line.onclose = () => {
      release();
      document.body.classList.add("studio-lost");
      setTimeout(connect, 500);
    };
  }

  // A timer of the page itself is slowed down in a hidden tab; that of a worker is not. One that sleeps has neither.
  function beat() {
    send({ k: "beat", held: studio.held });
  }
  const source = `setInterval(() => postMessage(0), ${BEAT})`;
  const ticker = new Worker(URL.createObjectURL(new Blob([source], { type: "text/javascript" })));
  ticker.onmessage = beat;

  studio.start = (page) => {
    studio.page = page;
    document.querySelector(".studio-footer")?.prepend(document.getElementById("q-notify") || "");
    connect();
  };

  // --- quick stop -----------------------------------------------------------------------------------------------
  studio.stop = () => {
    forget();
    send({ k: "stop" });
    // A second way, which needs no open line.
    fetch("/studio/quick-stop", { method: "POST", keepalive: true }).catch(() => {});
    const button = document.querySelector(".studio-stop");
    if (button) {
      button.classList.add("is-pressed");
      setTimeout(() => button.classList.remove("is-pressed"), 400);
    }
  };

  function takesText(element) {
    if (!element) return false;
    if (element.isContentEditable || element.tagName === "TEXTAREA") return true;
    if (element.tagName !== "INPUT" || element.readOnly) return false;
    return ["text", "search", "email", "url", "password", ""].includes(element.getAttribute("type") || "");
  }

  window.addEventListener(
    "keydown",
    (event) => {
      if (event.code === "Space" && (event.ctrlKey || !takesText(document.activeElement))) {
        event.preventDefault();
        event.stopImmediatePropagation();
        if (!event.repeat) studio.stop();
      }
    },
    true,
  );
  // A button with the focus would be pressed as the bar comes up.
  window.addEventListener(
    "keyup",
    (event) => {
      if (event.code === "Space" && (event.ctrlKey || !takesText(document.activeElement))) {
        event.preventDefault();
        event.stopImmediatePropagation();
      }
    },
    true,
  );

  // --- jog: as long as a button is held -----------------------------------------------------------------------------
  function hold(element) {
    if (studio.held) return;
    const number = ++holds;
    const direction = Number(element.dataset.jog);
    if (send({ k: "turn", hold: number, direction, group: element.dataset.group === "all" })) {
      studio.held = number;
      holder = element;
      element.classList.add("is-held");
    }
  }
  function release() {
    if (!studio.held) return;
    send({ k: "release", hold: studio.held });
    forget();
  }
  function forget() {
    studio.held = 0;
    if (holder) holder.classList.remove("is-held");
    holder = null;
  }
  studio.release = release;
  const jog = (event) => event.target.closest && event.target.closest("[data-jog]");
  window.addEventListener("pointerdown", (event) => {
    const button = jog(event);
    if (button && event.button === 0 && !button.disabled) hold(button);
  });
  for (const name of ["pointerup", "pointercancel", "blur", "pagehide", "contextmenu"]) {
    window.addEventListener(name, release);
  }
  window.addEventListener("pointerout", (event) => {
    if (holder && jog(event) === holder && !holder.contains(event.relatedTarget)) release();
  });
  document.addEventListener("visibilitychange", () => document.hidden && release());
  window.addEventListener("keydown", (event) => {
    const button = jog(event);
    if (button && event.key === "Enter") {
      event.preventDefault();
      if (!event.repeat) hold(button);
    }
  });
  window.addEventListener("keyup", (event) => event.key === "Enter" && release());

  // --- transitions of the state diagram -----------------------------------------------------------------------------
  function transition(event) {
    const item = event.target.closest && event.target.closest("[data-command]");
    if (item && item.getAttribute("aria-disabled") !== "true") emitEvent("studio_command", Number(item.dataset.command));
  }
  window.addEventListener("click", transition);
  window.addEventListener("keydown", (event) => event.key === "Enter" && transition(event));

  // --- light and dark -----------------------------------------------------------------------------------------------
  const THEMES = ["auto", "light", "dark"];
  function theme(name) {
    if (window.Quasar) Quasar.Dark.set(name === "auto" ? "auto" : name === "dark");
    document.documentElement.dataset.theme = name;
  }
  studio.theme = () => {
    const now = localStorage.getItem("studio-theme") || "auto";
    const next = THEMES[(THEMES.indexOf(now) + 1) % THEMES.length];
    localStorage.setItem("studio-theme", next);
    theme(next);
    return next;
  };
  window.addEventListener("load", () => theme(localStorage.getItem("studio-theme") || "auto"));
})();
