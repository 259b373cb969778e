// The dictionary's rows that can be seen.
(() => {
  "use strict";
  const dictionary = (window.studioDictionary = {});
  const visible = new Set();
  let told = 0;

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
})();
