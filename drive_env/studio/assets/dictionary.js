// The dictionary's rows that can be seen, and the favourites, which this browser keeps.
(() => {
  "use strict";
  const KEY = "studio-favourites";
  const dictionary = (window.studioDictionary = {});
  const visible = new Set();
  let told = 0;

  function favourites() {
    try {
      return JSON.parse(localStorage.getItem(KEY) || "[]");
    } catch {
      return [];
    }
  }
  function tell() {
    clearTimeout(told);
    told = setTimeout(() => emitEvent("dictionary_visible", [...visible]), 150);
  }
  const observer = new IntersectionObserver((rows) => {
    for (const row of rows) {
      if (row.isIntersecting) visible.add(row.target.dataset.key);
      else visible.delete(row.target.dataset.key);
    }
    tell();
  });
  dictionary.observe = () => {
    observer.disconnect();
    visible.clear();
    setTimeout(() => document.querySelectorAll("[data-key]").forEach((row) => observer.observe(row)), 50);
  };
  dictionary.toggle = (key) => {
    const now = favourites();
    const next = now.includes(key) ? now.filter((one) => one !== key) : [...now, key];
    localStorage.setItem(KEY, JSON.stringify(next));
    emitEvent("dictionary_favourites", next);
  };
  dictionary.start = () => {
    if (favourites().length) emitEvent("dictionary_favourites", favourites());
    dictionary.observe();
  };
})();
