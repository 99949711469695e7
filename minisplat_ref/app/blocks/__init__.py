"""One large scene in blocks: a coarse model of all of it, a plan, a training for each block, one model again.

A scene that neither memory nor patience has room for is divided on the ground plane into A x B blocks, which train
independently of each other, on one machine or on many (``minisplat-ref train SCENE --blocks AxB``):

1. *Coarse.* The whole scene is trained for a quarter of the iterations.
2. *Plan.* Cores have equal numbers of cameras, are half-open and cover the plane. A block's region is its core with a
   fifth of its width around. A photograph belongs to each block that at least 25 % of its pixels show, by the coarse
   model, and to others until nearly all of its pixels have a block; pixels that show other blocks are masked.
3. *Blocks.* Each starts from the coarse model's Gaussians in its region, and is an ordinary run.
4. *Merge.* Of each block the Gaussians in its core. Where blocks continue the coarse training, the merged model is
   trained for the last fifth of the iterations.

Dividing by cameras and deciding by visibility follow VastGaussian and CityGaussian; left out: appearance per
photograph, levels of detail, and blocks that communicate while they train (DOGS).

============  ====================================================================================================
``grid``      cores and regions on the plane, from where the cameras are
``coverage``  which pixels of which photograph show a block
``plan``      the plan, its file and its parts
``picture``   the plan as a picture
``merge``     one model of all blocks, as an ordinary run
``train``     the four phases, one by one or by workers, continued where they were
============  ====================================================================================================
"""
