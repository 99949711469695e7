"""``adaptive``: the scene decides how many Gaussians it needs and when training ends.

No paper has published the whole; ``docs/measured/adaptive.md`` has the evidence for each rule, and the failed attempts.
There is no schedule, and no setting depends on the scene:

*Grow.* Every 100 iterations the Gaussians whose mean screen gradient reaches a threshold are halved
(:mod:`minisplat_ref.strategy.halving`), at most a fifth of all at a time; first those that are responsible for most of
the images' error (:mod:`minisplat_ref.strategy.error_weights`). A Gaussian that fits the pixels that it covers has a
small gradient, so growth fades where a scene has enough.

*View dependence.* Each Gaussian has as many degrees of the harmonics as the views that show it determine.

*Measure.* Every 100 iterations the held-out training views are rendered. The gain of their PSNR for each doubling of
the work, in pairs (tile, Gaussian), is the slope of a line through the measurements since half of the work. Of fewer
than 16 training views none is held out: they are worth more in the training than two of them as votes on its length,
so it continues as soon as it may.

*See more, and cool down.* Large photographs are halved at first. When the slope falls below a threshold, they are shown
at twice the size; when they are as they were taken, rates fall and all training views are trained on
(:mod:`minisplat_ref.training.pace`).

*Calibrate.* Where the tracks of the sparse points show that photographs differ in their exposure, each has its own from
the first iteration on (:mod:`minisplat_ref.strategy.track_gains`). A sky, compensated opacities and refined poses are
each switched on once, and only if parameters fitted to one half of the photographs, or of each photograph, improve the
other half.

*Begin densely.* Stereo adds surface points where structure from motion has found few
(:mod:`minisplat_ref.training.dense_start`).

*Look through.* Gaussians that lie before sparse points which photographs show are removed every 100 iterations, and
those beside a camera, nearer than what is known around it. So are those that are mostly seen where masks leave pixels
out.

*Prune.* While the rates fall, Gaussians that the photographs would hardly miss are removed in slices.

================  ==================================================================================================
``recipe``        the recipe: the schedule of the rules
``numbers``       all numbers, each with its unit and its reason
``growth``        which Gaussians are halved
``degrees``       the degree of the harmonics of each Gaussian
``progress``      the gain of the held-out views, and its consequence: larger views, or the end
``switches``      calibrations that are switched on if the photographs need them: the rule, and the table
``evidence``      parameters that are fitted to one half of each photograph and judged on the other
``pose``          the pose of each photograph
``antialiasing``  compensated opacities, where photographs differ in resolution
``sky``           a sky behind the scene
``veils``         Gaussians before sparse points that photographs show, beside cameras or outside masks: removed
``prune``         removal of Gaussians while the rates fall
================  ==================================================================================================
"""
